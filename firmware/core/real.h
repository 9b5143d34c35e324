/* Type of the holding law, of currents, and of positions in frames whose signals are floats. With float, for a processor
 * that computes only that quickly, a current may differ from the reference by one step of the D/A converter. */
#ifndef REAL_H
#define REAL_H

#ifndef BOARD_REAL
#define BOARD_REAL double
#endif
typedef BOARD_REAL board_real;

#endif
