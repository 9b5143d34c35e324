/* The arguments of board_posix, each as NAME=VALUE. */
#ifndef OPTIONS_H
#define OPTIONS_H

#include <stdbool.h>
#include <stdint.h>

#include "board.h"

struct options {
    int64_t machine;  /* descriptor of the machine's socket */
    const char *bus;  /* empty: lockstep, the machine has the bus and the time too */
    bool fd;          /* a bus of CAN FD */
    int64_t lead_ns;  /* time for which the process begins before the sampling time */
    struct board_config config;
};

/* False, with a message, if an argument is unknown, missing or no number. */
bool options_read(struct options *options, int count, char **arguments);

#endif
