#include "scale.h"

#include <stdbool.h>

/* The rule: up from the floor where more than half is left, and where half is left of an odd one. */
static bool goes_up(bool more, bool half, bool odd)
{
    return more || (half && odd);
}

int64_t scaled(struct scale scale, int32_t counts)
{
    /* 31 bits by 31 bits fit into 63. */
    const int64_t product = (int64_t)counts * scale.numerator;
    const int64_t denominator = scale.denominator;
    int64_t quotient = product / denominator;
    int64_t rest = product % denominator;

    if (rest < 0) {
        /* C rounds to zero; from here on the quotient is the floor. */
        rest += denominator;
        quotient -= 1;
    }
    return quotient + (goes_up((2 * rest) > denominator, (2 * rest) == denominator, (quotient % 2) != 0) ? 1 : 0);
}

int32_t nearest(board_real value)
{
    const board_real half = (board_real)0.5;
    int32_t whole = (int32_t)value;
    board_real rest;

    if ((board_real)whole > value) {
        /* C rounds to zero; from here on it is the floor. */
        whole -= 1;
    }
    rest = value - (board_real)whole;
    return whole + (goes_up(rest > half, rest >= half, (whole % 2) != 0) ? 1 : 0);
}

int64_t nearest_of_many(board_real value)
{
    /* Both parts are exact, and the first is even. */
    const board_real many = (board_real)1073741824;
    const int64_t first = (int64_t)(value / many);

    return (first * 1073741824) + nearest(value - ((board_real)first * many));
}

int64_t limited(int64_t value, int64_t least, int64_t largest)
{
    int64_t within = value;

    if (value > largest) {
        within = largest;
    } else if (value < least) {
        within = least;
    } else {
        /* It fits. */
    }
    return within;
}

board_real limited_real(board_real value, board_real least, board_real largest)
{
    board_real within = value;

    if (value > largest) {
        within = largest;
    } else if (value < least) {
        within = least;
    } else {
        /* It fits. */
    }
    return within;
}
