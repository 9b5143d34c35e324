/* Made by scripts/make_firmware_frames.py from config/straightcomp.dbc: do not edit. */
#ifndef WIRE_LIMITS_H
#define WIRE_LIMITS_H

#define WIRE_POSITION_COUNT (1e-07) /* m */
#define WIRE_CURRENT_COUNT (0.0001) /* A */
#define WIRE_X_LIMIT (33554431) /* largest count of x, to both sides */
#define WIRE_Y_LIMIT (524287) /* the same of y */
#define WIRE_CURRENT_LIMIT (32767) /* the same of a current */
#define WIRE_ALIVE_MODULUS (15u)
#define WIRE_COUNTER_MODULUS (4026531840u) /* of the sample counter */
#define WIRE_ECHO_MODULUS (256u) /* of its echo in a classic frame */
#define WIRE_CURRENT_EVERY (10u) /* samples to a CoilCurrent */
#define WIRE_HEARTBEAT_NS (INT64_C(50000000))

#endif
