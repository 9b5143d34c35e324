/* The driver's command, from either kind of bus. */
#ifndef COMMAND_H
#define COMMAND_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* No command has this alive counter: profile 1 reserves it for "not valid". */
#define COMMAND_NO_ALIVE (15u)

struct command {
    uint8_t alive;
    bool enable;
    bool reset;
    int16_t current; /* counts of the frame */
    uint32_t echo;   /* number of the sample that it answers, modulo 256 on a classic bus */
};

/* Unpack a frame with the identifier of a command. False if its length, its CRC with the data id, its alive counter or
 * the pattern of one of its switches is wrong; the command is then without meaning. */
bool command_checked(struct command *command, bool fd, uint32_t identifier, const uint8_t *data, size_t length);

#endif
