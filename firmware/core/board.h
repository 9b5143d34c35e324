/* A board between the encoders, the power amplifier and the driver on CAN, without operating system and allocation.
 *
 * What it does is in docs/can.md, "What the firmware does"; docs/firmware.md says how to put it on a microcontroller.
 * Times are ns of the board's own clock, which must not step. None of these functions may interrupt another one for the
 * same board: call them at one interrupt priority, or mask it. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "output.h"
#include "wire.h"

/* Sends a frame, whose identifier has WIRE_EXTENDED set if it is one of 29 bits; `fd`: in the format of CAN FD, with bit
 * rate switch. It must not wait. */
typedef void (*board_send_t)(void *context, uint32_t identifier, bool fd, const uint8_t *data, size_t length);

struct board_config {
    const struct wire *wire;   /* the frames */
    uint8_t node;              /* 1 to 127 */
    int64_t period_ns;         /* of the samples */
    int64_t delay_ns;          /* from a sample until its command acts */
    board_real current_limit;  /* largest control current that is accepted, A */
    struct wire_scaling scaling;
    struct output_config output;
};

/* One simultaneous reading. */
struct board_reading {
    int32_t x; /* counts of the encoders */
    int32_t y;
    board_real current; /* in the coils, A */
    bool valid;         /* both encoders work */
    bool referenced;    /* x is counted from its reference */
};

/* Which frame of one identifier is the next. */
struct board_turn {
    uint32_t samples; /* until it is sent */
    uint32_t alive;
    uint32_t page;
};

struct board {
    struct board_config config;
    board_send_t send;
    void *context;
    struct output output;
    enum board_fault fault; /* latched; a command timeout is latched in `output` */
    bool seen_off;
    bool commanded;
    uint32_t command_alive; /* of the last command, if `commanded` */
    struct command_sets commands;
    struct board_turn turns[WIRE_FRAMES];
    uint8_t strikes;
    uint32_t counter; /* of the newest sample */
    uint32_t next_counter;
    uint32_t oldest_echo; /* samples */
    int64_t newest_ns;
    int64_t next_heartbeat_ns;
    uint32_t refused_commands; /* failed a check, were repeated, came too late, or found no room */
};

/* Begin with the amplifier off and say so on the bus. False if the configuration is not allowed: nothing happens. A board
 * must not be copied or moved afterwards. */
bool board_start(struct board *board, const struct board_config *config, board_send_t send, output_drive_t drive,
                 void *context, int64_t now_ns);

/* Take one sample, read at `now_ns`, and send it. What is due by then is done before: read the converters, then call. */
void board_sample(struct board *board, int64_t now_ns, const struct board_reading *reading);

/* Take a frame of the bus that arrived at `at_ns`, and say whether it is for this board. In an identifier of 29 bits
 * WIRE_EXTENDED is set. Then call board_act(), for a late command, and look at board_next_ns(). */
bool board_receive(struct board *board, uint32_t identifier, const uint8_t *data, size_t length, int64_t at_ns);

/* Do what is due by `now_ns`: call it at board_next_ns(). */
void board_act(struct board *board, int64_t now_ns);

/* When board_act() is to be called next; OUTPUT_NEVER if there is nothing to do. */
int64_t board_next_ns(const struct board *board);

/* Switch off and latch a fault that the hardware reports. */
void board_trip(struct board *board, enum board_fault fault);

/* What the next sample reports. */
enum board_amplifier board_reported_amplifier(const struct board *board);
enum board_fault board_reported_fault(const struct board *board);

#endif
