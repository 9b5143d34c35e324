#include "bus.h"

#include "wire.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#define REOPEN_NS (100000000)
/* Head of the hub's packets: time in ns (8 bytes), identifier (4), with WIRE_EXTENDED, and flags (1); see
 * hardware/can/hub.py. */
#define HUB_HEAD (13u)
#define HUB_FD (8u)
#define HUB_BIT_RATE_SWITCH (16u)
#define HUB_OTHERS (6u) /* remote, error */

int64_t clock_ns(int clock)
{
    struct timespec now;

    (void)clock_gettime((clockid_t)clock, &now);
    return ((int64_t)now.tv_sec * 1000000000) + now.tv_nsec;
}

static bool is_hub(const struct bus *bus)
{
    return strchr(bus->name, '/') != NULL;
}

static int opened_hub(const char *path)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    const int descriptor = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);

    (void)strncpy(address.sun_path, path, sizeof(address.sun_path) - 1u);
    if ((descriptor >= 0) && (connect(descriptor, (const struct sockaddr *)&address, sizeof(address)) != 0)) {
        const int error = errno;

        (void)close(descriptor);
        errno = error;
        return -1;
    }
    return descriptor;
}

static int opened_interface(const char *name, bool fd)
{
    const int on = 1;
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(name)};
    const int descriptor = socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW);

    if (descriptor < 0) {
        return -1;
    }
    if (address.can_ifindex == 0) {
        /* Index 0 would be every interface. */
        (void)close(descriptor);
        errno = ENODEV;
        return -1;
    }
    if ((fd && (setsockopt(descriptor, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof(on)) != 0)) ||
        (setsockopt(descriptor, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof(on)) != 0) ||
        (bind(descriptor, (const struct sockaddr *)&address, sizeof(address)) != 0)) {
        const int error = errno;

        (void)close(descriptor);
        errno = error;
        return -1;
    }
    return descriptor;
}

static void lose(struct bus *bus, int error)
{
    if (error != bus->complained) {
        (void)fprintf(stderr, "board_posix: bus %s: %s\n", bus->name, strerror(error));
        bus->complained = error;
    }
    if (bus->descriptor >= 0) {
        (void)close(bus->descriptor);
        bus->descriptor = -1;
    }
}

void bus_start(struct bus *bus, const char *name, bool fd)
{
    const struct bus started = {.name = name, .fd = fd, .descriptor = -1};

    *bus = started;
    bus_open_again(bus);
}

void bus_open_again(struct bus *bus)
{
    const int64_t now_ns = clock_ns(CLOCK_MONOTONIC);

    if ((bus->descriptor < 0) && (now_ns >= bus->next_opening_ns)) {
        bus->next_opening_ns = now_ns + REOPEN_NS;
        bus->descriptor = is_hub(bus) ? opened_hub(bus->name) : opened_interface(bus->name, bus->fd);
        if (bus->descriptor < 0) {
            lose(bus, errno);
        } else {
            bus->complained = 0;
        }
    }
}

static ssize_t sent_to_hub(const struct bus *bus, uint32_t identifier, bool fd, const uint8_t *data, size_t length)
{
    uint8_t packet[HUB_HEAD + BUS_LONGEST];
    const int64_t now_ns = clock_ns(CLOCK_REALTIME);

    (void)memcpy(&packet[0], &now_ns, 8u);
    (void)memcpy(&packet[8], &identifier, 4u);
    packet[12] = fd ? (uint8_t)(HUB_FD | HUB_BIT_RATE_SWITCH) : 0u;
    (void)memcpy(&packet[HUB_HEAD], data, length);
    return send(bus->descriptor, packet, HUB_HEAD + length, MSG_NOSIGNAL);
}

static ssize_t sent_to_interface(const struct bus *bus, uint32_t identifier, bool fd, const uint8_t *data,
                                 size_t length)
{
    struct canfd_frame frame = {.can_id = identifier, .len = (uint8_t)length, .flags = fd ? CANFD_BRS : 0};

    (void)memcpy(frame.data, data, length);
    /* A classic frame begins as one of CAN FD does. */
    return write(bus->descriptor, &frame, fd ? CANFD_MTU : CAN_MTU);
}

void bus_send(struct bus *bus, uint32_t identifier, bool fd, const uint8_t *data, size_t length)
{
    ssize_t sent = -1;

    if (bus->descriptor >= 0) {
        sent = is_hub(bus) ? sent_to_hub(bus, identifier, fd, data, length)
                           : sent_to_interface(bus, identifier, fd, data, length);
    }
    bus->unsent += (sent < 0) ? 1u : 0u;
    /* Linux reports this once, to who calls first: reading would never find it. All others but a full queue it does. */
    if ((sent < 0) && (bus->descriptor >= 0) && (errno == ENETDOWN)) {
        lose(bus, errno);
    }
}

/* 1: a frame; 0: one of another kind, or a packet that is none; -1: see errno. */
static int received_from_hub(const struct bus *bus, struct bus_frame *frame)
{
    uint8_t packet[HUB_HEAD + BUS_LONGEST];
    const ssize_t size = recv(bus->descriptor, packet, sizeof(packet), 0);

    if (size == 0) {
        errno = EPIPE;
        return -1;
    }
    if (size < 0) {
        return -1;
    }
    if (((size_t)size < HUB_HEAD) || ((packet[12] & HUB_OTHERS) != 0u)) {
        return 0;
    }
    (void)memcpy(&frame->sent_ns, &packet[0], 8u);
    (void)memcpy(&frame->identifier, &packet[8], 4u);
    frame->length = (size_t)size - HUB_HEAD;
    (void)memcpy(frame->data, &packet[HUB_HEAD], frame->length);
    return 1;
}

static int received_from_interface(const struct bus *bus, struct bus_frame *frame)
{
    struct canfd_frame raw = {0};
    union {
        struct cmsghdr align;
        uint8_t bytes[CMSG_SPACE(sizeof(struct timespec))];
    } control;
    struct iovec part = {.iov_base = &raw, .iov_len = sizeof(raw)};
    struct msghdr message = {
        .msg_iov = &part, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof(control)};
    const ssize_t size = recvmsg(bus->descriptor, &message, 0);
    struct cmsghdr *stamp;

    if (size < 0) {
        return -1;
    }
    if ((raw.can_id & (CAN_RTR_FLAG | CAN_ERR_FLAG)) != 0u) {
        return 0;
    }
    frame->sent_ns = clock_ns(CLOCK_REALTIME);
    stamp = CMSG_FIRSTHDR(&message);
    if ((stamp != NULL) && (stamp->cmsg_level == SOL_SOCKET) && (stamp->cmsg_type == SO_TIMESTAMPNS)) {
        struct timespec at;

        (void)memcpy(&at, CMSG_DATA(stamp), sizeof(at));
        frame->sent_ns = ((int64_t)at.tv_sec * 1000000000) + at.tv_nsec;
    }
    /* Its flag of an extended identifier is WIRE_EXTENDED. */
    frame->identifier = raw.can_id;
    frame->length = (raw.len <= BUS_LONGEST) ? raw.len : BUS_LONGEST;
    (void)memcpy(frame->data, raw.data, frame->length);
    return 1;
}

bool bus_receive(struct bus *bus, struct bus_frame *frame)
{
    int received = 0;

    while ((bus->descriptor >= 0) && (received == 0)) {
        received = is_hub(bus) ? received_from_hub(bus, frame) : received_from_interface(bus, frame);
        if ((received < 0) && (errno != EAGAIN) && (errno != EINTR)) {
            lose(bus, errno);
        }
    }
    return received > 0;
}
