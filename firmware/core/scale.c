#include "scale.h"

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
    if (((2 * rest) > denominator) || (((2 * rest) == denominator) && ((quotient % 2) != 0))) {
        quotient += 1;
    }
    return quotient;
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
    if ((rest > half) || ((rest >= half) && ((whole % 2) != 0))) {
        whole += 1;
    }
    return whole;
}

int64_t nearest_of_many(board_real value)
{
    const board_real half = (board_real)0.5;
    int64_t whole = (int64_t)value;
    board_real rest;

    if ((board_real)whole > value) {
        /* C rounds to zero; from here on it is the floor. */
        whole -= 1;
    }
    rest = value - (board_real)whole;
    if ((rest > half) || ((rest >= half) && ((whole % 2) != 0))) {
        whole += 1;
    }
    return whole;
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
