/* Counts of a converter or encoder in counts of the frames, by whole numbers: the same on every processor. */
#ifndef SCALE_H
#define SCALE_H

#include <stdint.h>

/* One count of the converter is `numerator` / `denominator` counts of the frame, e.g. 1/20 for an encoder of 5 nm in
 * frames of 0.1 um. A negative numerator turns the sign over. The denominator is positive. */
struct scale {
    int32_t numerator;
    int32_t denominator;
};

/* Scaled to the nearest count, a tie to the even one, as Python's round() does. */
int64_t scaled(struct scale scale, int32_t counts);

#endif
