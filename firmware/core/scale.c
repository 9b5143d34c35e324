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
