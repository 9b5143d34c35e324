/* The board's bus: a network interface of SocketCAN, or the hub of straightcomp (its name then contains a slash). */
#ifndef BUS_H
#define BUS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define BUS_LONGEST (64u)

struct bus {
    const char *name;
    bool fd;
    int descriptor; /* -1 while the bus is lost */
    int64_t next_opening_ns;
    int complained; /* errno of the last loss that was told */
    uint32_t unsent;
};

struct bus_frame {
    uint32_t identifier; /* WIRE_EXTENDED is set in one of 29 bits */
    size_t length;
    uint8_t data[BUS_LONGEST];
    int64_t sent_ns; /* on the system's clock, CLOCK_REALTIME */
};

/* ns of one of the system's clocks. */
int64_t clock_ns(int clock);

void bus_start(struct bus *bus, const char *name, bool fd);

/* Open the bus again, ten times a second at most, if it is lost. */
void bus_open_again(struct bus *bus);

/* Send without waiting; a frame that the bus does not take is counted and lost. */
void bus_send(struct bus *bus, uint32_t identifier, bool fd, const uint8_t *data, size_t length);

/* Take the next data frame; false if there is none. */
bool bus_receive(struct bus *bus, struct bus_frame *frame);

#endif
