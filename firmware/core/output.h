/* What is asked of the power amplifier, and when.
 *
 * A command acts a fixed time after the sample that it answers, so that the loop has no jitter of host and bus. When the
 * next one is late, the board holds the platform: it applies the mean of the commands before, which balances the
 * magnets' pull at that place; it takes back the impulse that the last commands gave beyond that mean; and it adds a
 * stiffness about the last reading, since the magnets' own is negative. */
#ifndef OUTPUT_H
#define OUTPUT_H

#include <stdbool.h>
#include <stdint.h>

#include "real.h"

/* Commands that wait for their time, at most: one for each sample of the longest delay, 10, and some more. */
#define OUTPUT_WAITING (16u)
/* Later than any time in ns. */
#define OUTPUT_NEVER (INT64_MAX)

/* Sets the D/A converter to `code` and the bias current on or off. `at_ns` is the time for which this was asked; a board
 * that calls output_act() in time need not look at it. While `on` is false, `code` is zero. */
typedef void (*output_drive_t)(void *context, int64_t at_ns, bool on, int32_t code);

struct output_config {
    int64_t command_timeout_ns; /* age of the newest command at which the amplifier is switched off */
    int64_t hold_after_ns;      /* time since a command took effect from which the board holds */
    int32_t half_codes;         /* codes of the D/A converter below zero */
    board_real code_current;    /* control current of one code, A */
    board_real hold_weight;     /* share of each command in the mean */
    board_real hold_kept;       /* share of an impulse that friction leaves after a sample */
    board_real hold_braking;    /* share of that which the board takes back in a sample */
    board_real hold_stiffness;  /* control current per displacement, A/m */
    board_real y_count;         /* one count of the encoder of y, m */
};

struct output_command {
    int64_t at_ns;
    board_real current; /* A */
};

struct output {
    const struct output_config *config;
    output_drive_t drive;
    void *context;
    int64_t now_ns;          /* of the newest sample */
    int64_t last_command_ns; /* when the newest command took or takes effect */
    int64_t hold_at_ns;
    bool on;
    bool timed_out; /* latched until output_reset() */
    bool holding;
    uint8_t first; /* of the commands that wait, in a ring */
    uint8_t waiting_count;
    struct output_command waiting[OUTPUT_WAITING];
    int32_t reading; /* newest of y, counts of its encoder */
    int32_t anchor;  /* where the platform is held */
    int32_t code;
    board_real mean;    /* of the commands, A */
    board_real impulse; /* beyond that mean, A * samples */
};

/* Begin with the amplifier off. */
void output_start(struct output *output, const struct output_config *config, output_drive_t drive, void *context,
                  int64_t now_ns);

/* Have a current in A act at `at_ns`, or now if that has passed. False if too many wait: it is dropped. */
bool output_command(struct output *output, board_real current, int64_t at_ns);

/* Do what is due by `now_ns`. */
void output_act(struct output *output, int64_t now_ns);

/* Time of the next thing to do, OUTPUT_NEVER if there is none: where to set a compare timer. */
int64_t output_next_ns(const struct output *output);

/* Take y's reading in encoder counts at a sample, after output_act() for the same time: hold, or switch off for want of
 * commands. */
void output_sample(struct output *output, int64_t now_ns, int32_t y_reading);

void output_switch_on(struct output *output);
void output_switch_off(struct output *output);
void output_reset(struct output *output);

#endif
