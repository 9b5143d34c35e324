/* The simulated machine in the parent process: encoders, amplifier and stage, in packets over a socket.
 *
 * The parent is straightcomp_ros/hardware/can/emulator.py; the layouts of the packets stand there too. */
#ifndef MACHINE_H
#define MACHINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "board.h"

#define MACHINE_LONGEST (80u)

/* First byte of a packet. From the parent: */
#define MACHINE_TICK ((uint8_t)'T')    /* in lockstep: the time is now ... */
#define MACHINE_RECEIVE ((uint8_t)'R') /* in lockstep: a frame arrived at ... */
/* To the parent: */
#define MACHINE_SAMPLE ((uint8_t)'S') /* what do the encoders read at ..., for sample number ... */
#define MACHINE_DRIVE ((uint8_t)'D')  /* amplifier and D/A converter are set from ... on */
#define MACHINE_STAGE ((uint8_t)'G')  /* a frame that is not the board's, for the simulated stage */
#define MACHINE_FRAME ((uint8_t)'F')  /* in lockstep: the board sends a frame */
#define MACHINE_DONE ((uint8_t)'E')   /* in lockstep: the call ends, with the board's state */

/* A packet that is put together. */
struct packet {
    size_t size;
    uint8_t bytes[MACHINE_LONGEST];
};

struct packet packet_of(uint8_t kind);
void packet_add(struct packet *packet, const void *bytes, size_t size);
void packet_add_time(struct packet *packet, int64_t time_ns);
void packet_add_word(struct packet *packet, uint32_t word);
void packet_add_byte(struct packet *packet, uint8_t byte);

/* Send a packet to the machine; ends the process if the machine is gone. */
void machine_send(int socket, const struct packet *packet);

/* Ask for the reading of a sample. What the parent adds, the simulation's truth in a frame of its own, comes back in
 * `truth`, with its identifier; its size is 0 without it. */
void machine_sample(int socket, int64_t at_ns, uint32_t counter, struct board_reading *reading, struct packet *truth,
                    uint32_t *truth_identifier);

/* Receive a packet; ends the process if the machine is gone. */
size_t machine_receive(int socket, uint8_t *bytes, size_t size);

#endif
