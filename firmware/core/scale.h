/* Counts of a converter or encoder in counts of the frames: by whole numbers, the same on every processor, or by real
 * ones where a signal is a float or has an offset. */
#ifndef SCALE_H
#define SCALE_H

#include <stdint.h>

#include "real.h"

/* One count of the encoder is `numerator` / `denominator` counts of the frame, e.g. 1/20 for an encoder of 5 nm in
 * frames of 0.1 um. A negative numerator turns the sign over. The denominator is positive. */
struct scale {
    int32_t numerator;
    int32_t denominator;
};

/* All of these round to the nearest whole number, a tie to the even one, as Python's round() does. */

int64_t scaled(struct scale scale, int32_t counts);

/* Of a value between -2^30 and 2^30; the other takes any up to 2^62, but more of a processor that has no whole numbers of
 * 64 bits. */
int32_t nearest(board_real value);
int64_t nearest_of_many(board_real value);

int64_t limited(int64_t value, int64_t least, int64_t largest);
board_real limited_real(board_real value, board_real least, board_real largest);

#endif
