#include "machine.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

/* Two counts, the current in A, whether they are valid, identifier of the frame with the truth. */
#define READING_HEAD (21u)

struct packet packet_of(uint8_t kind)
{
    const struct packet packet = {.size = 1u, .bytes = {kind}};

    return packet;
}

void packet_add(struct packet *packet, const void *bytes, size_t size)
{
    if (size <= (MACHINE_LONGEST - packet->size)) {
        (void)memcpy(&packet->bytes[packet->size], bytes, size);
        packet->size += size;
    }
}

void packet_add_time(struct packet *packet, int64_t time_ns)
{
    packet_add(packet, &time_ns, sizeof(time_ns));
}

void packet_add_word(struct packet *packet, uint32_t word)
{
    packet_add(packet, &word, sizeof(word));
}

void packet_add_byte(struct packet *packet, uint8_t byte)
{
    packet_add(packet, &byte, sizeof(byte));
}

void machine_send(int socket, const struct packet *packet)
{
    if (send(socket, packet->bytes, packet->size, MSG_NOSIGNAL) < 0) {
        exit(EXIT_SUCCESS);
    }
}

size_t machine_receive(int socket, uint8_t *bytes, size_t size)
{
    ssize_t received;

    do {
        received = recv(socket, bytes, size, 0);
    } while ((received < 0) && (errno == EINTR));
    if (received <= 0) {
        /* The parent has ended, and with it the machine. */
        exit(EXIT_SUCCESS);
    }
    return (size_t)received;
}

void machine_sample(int socket, int64_t at_ns, uint32_t counter, struct board_reading *reading, struct packet *truth,
                    uint32_t *truth_identifier)
{
    struct packet request = packet_of(MACHINE_SAMPLE);
    uint8_t answer[READING_HEAD + MACHINE_LONGEST];
    size_t size;
    double current;

    packet_add_time(&request, at_ns);
    packet_add_word(&request, counter);
    machine_send(socket, &request);
    size = machine_receive(socket, answer, sizeof(answer));
    if ((size < READING_HEAD) || ((size - READING_HEAD) > MACHINE_LONGEST)) {
        (void)fprintf(stderr, "board_posix: the machine's answer has %zu bytes\n", size);
        exit(EXIT_FAILURE);
    }
    (void)memcpy(&reading->x, &answer[0], 4u);
    (void)memcpy(&reading->y, &answer[4], 4u);
    (void)memcpy(&current, &answer[8], 8u);
    reading->current = (board_real)current;
    reading->valid = (answer[16] & 1u) != 0u;
    reading->referenced = (answer[16] & 2u) != 0u;
    (void)memcpy(truth_identifier, &answer[17], 4u);
    truth->size = size - READING_HEAD;
    (void)memcpy(truth->bytes, &answer[READING_HEAD], truth->size);
}
