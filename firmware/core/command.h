/* A command of the host, and the commands whose signals come in frames of several messages. */
#ifndef COMMAND_H
#define COMMAND_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "real.h"

/* What a frame says, as bits of `given`. */
#define COMMAND_ALIVE (1u)
#define COMMAND_ENABLE (2u)
#define COMMAND_RESET (4u)
#define COMMAND_CURRENT (8u)
#define COMMAND_ECHO (16u)

/* Commands whose frames may be on their way at once. */
#define COMMAND_SETS (3u)

struct command {
    uint8_t given;
    bool enable;
    bool reset;
    uint32_t alive;
    uint32_t echo;      /* number of the sample that is answered, as far as the frame has room */
    board_real current; /* A */
};

/* Frames of one command. */
struct command_set {
    uint32_t count;
    int64_t begin_ns;
    uint8_t parts; /* bit mask of those that have come */
    uint8_t first; /* the first part that has a count */
    bool closed;
    struct command command;
};

struct command_sets {
    uint8_t parts;       /* frames of a command */
    uint32_t modulus;    /* of the count by which they belong together; 0: by their time */
    int64_t longest_ns;  /* time within which a frame with the same count belongs to the same command */
    uint8_t used;
    struct command_set sets[COMMAND_SETS]; /* the oldest first */
};

enum command_part { COMMAND_WAITS, COMMAND_REPEATED, COMMAND_WHOLE };

void command_sets_start(struct command_sets *sets, uint8_t parts, uint32_t modulus, int64_t period_ns);

/* Take the frame of the `part`-th message; with COMMAND_WHOLE `command` is the whole one. */
enum command_part command_sets_add(struct command_sets *sets, uint8_t part, struct command *command, int64_t at_ns);

#endif
