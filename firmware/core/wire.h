/* The frames between a board and its host, as a DBC file and the meaning of its signals describe them.
 *
 * What is declared here as data is in wire.c of firmware/generated, or in that of your board, which `straightcomp can
 * firmware` makes from your stage file. */
#ifndef WIRE_H
#define WIRE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "command.h"
#include "protection.h"
#include "real.h"
#include "scale.h"

/* Set in an identifier of 29 bits, as in DBC files and in Linux's frames. */
#define WIRE_EXTENDED (0x80000000u)
/* Bytes of the longest frame. */
#define WIRE_LONGEST (64u)
/* Messages of a board, at most: one for each signal that means something. */
#define WIRE_FRAMES (8u)

/* Why the amplifier is off. */
enum board_fault {
    BOARD_FAULT_NONE = 0,
    BOARD_FAULT_COMMAND_TIMEOUT = 1,
    BOARD_FAULT_COMMAND_CHECK = 2,
    BOARD_FAULT_CURRENT_RANGE = 3,
    BOARD_FAULT_ENCODER = 4,
    BOARD_FAULT_OVERCURRENT = 5,
    BOARD_FAULT_SUPPLY = 6,
    BOARD_FAULT_INTERNAL = 7
};

enum board_amplifier { BOARD_AMPLIFIER_OFF = 1, BOARD_AMPLIFIER_ON = 2, BOARD_AMPLIFIER_FAULT = 3 };

/* From counts of the encoders to the frames' signals. */
struct wire_scaling {
    struct scale x; /* to counts of a signal that is a whole number without offset */
    struct scale y;
    board_real x_count; /* one count of the encoder, m: for any other signal */
    board_real y_count;
};

/* What a frame of the board may say. */
struct wire_report {
    uint32_t alive;   /* of this frame */
    uint32_t counter; /* of the sample */
    int32_t x;        /* counts of the encoder */
    int32_t y;
    board_real current; /* in the coils, A */
    enum board_amplifier amplifier;
    enum board_fault fault;
    bool good;       /* both readings may be used */
    bool referenced; /* x is counted from its reference */
    const struct wire_scaling *scaling;
};

/* Frames of one identifier that the board sends. */
struct wire_frame {
    uint32_t identifier; /* at node 1 */
    bool fd;             /* in the format of CAN FD */
    uint8_t length;
    uint8_t pages;       /* of the multiplexed signals that take turns; 1 without */
    uint32_t every;      /* samples from one to the next */
    uint32_t alive_most; /* after which the count of these frames begins again; 0 without a count */
    struct protection protection;
    void (*pack)(uint8_t *data, const struct wire_report *report, uint32_t page);
};

/* Frames of one identifier that the host sends. */
struct wire_order {
    uint32_t identifier; /* at node 1 */
    uint8_t length;
    struct protection protection;
    /* False if a value is none that has a meaning. */
    bool (*unpack)(struct command *command, const uint8_t *data, size_t length);
};

struct wire_heartbeat {
    uint32_t identifier; /* at node 1 */
    bool fd;
    uint8_t length;
    int64_t period_ns;
    void (*pack)(uint8_t *data, bool boot_up);
};

struct wire {
    const char *source; /* what it was made from */
    uint8_t frame_count;
    uint8_t order_count;
    const struct wire_frame *frames;
    const struct wire_order *orders;
    uint32_t order_modulus; /* of the count by which frames of a command belong together; 0: by their time */
    uint32_t counter_most;  /* after which the number of the samples begins again */
    bool echoes;            /* commands name the sample that they answer */
    uint32_t echo_most;
    const struct wire_heartbeat *heartbeat; /* NULL: none */
    bool (*fits)(const struct wire_report *report); /* whether both readings are within their signals */
};

/* For each kind of bus; NULL if it was not made. */
extern const struct wire *const wire_classic;
extern const struct wire *const wire_fd;

#endif
