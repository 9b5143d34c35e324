/* The firmware core as a process of a POSIX system, with a simulated machine in its parent process.
 *
 * `straightcomp dsp` starts it where can.firmware names it. On a bus it keeps the time itself, as a board does. In lockstep the
 * parent has the bus and the time: every call of the core is a packet. */
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "board.h"
#include "bus.h"
#include "machine.h"
#include "options.h"

/* Frames taken between two looks at the clock: a babbling node must not keep the board from its samples. */
#define AT_ONCE (64)
#define RECEIVE_HEAD (13u)

struct process {
    struct board board;
    struct bus bus;
    int machine;
    bool lockstep;
    int64_t next_sample_ns;
};

static void send_frame(void *context, uint32_t identifier, bool fd, const uint8_t *data, size_t length)
{
    struct process *process = context;

    if (process->lockstep) {
        struct packet packet = packet_of(MACHINE_FRAME);

        packet_add_byte(&packet, fd ? 1u : 0u);
        packet_add_word(&packet, identifier);
        packet_add(&packet, data, length);
        machine_send(process->machine, &packet);
    } else {
        bus_send(&process->bus, identifier, fd, data, length);
    }
}

static void drive(void *context, int64_t at_ns, bool on, int32_t code)
{
    const struct process *process = context;
    struct packet packet = packet_of(MACHINE_DRIVE);

    packet_add_time(&packet, at_ns);
    packet_add_byte(&packet, on ? 1u : 0u);
    packet_add(&packet, &code, sizeof(code));
    machine_send(process->machine, &packet);
}

/* Take the samples up to `until_ns`. */
static void sample(struct process *process, int64_t until_ns)
{
    while (process->next_sample_ns <= until_ns) {
        const struct board *board = &process->board;
        struct board_reading reading;
        struct packet truth;
        uint32_t identifier;

        board_act(&process->board, process->next_sample_ns);
        machine_sample(process->machine, process->next_sample_ns, board->next_counter, &reading, &truth, &identifier);
        if (truth.size > 0u) {
            send_frame(process, identifier, true, truth.bytes, truth.size);
        }
        board_sample(&process->board, process->next_sample_ns, &reading);
        process->next_sample_ns += board->config.period_ns;
    }
}

/* What the parent, in lockstep, asks of the board. */
static void answer_done(const struct process *process)
{
    struct packet packet = packet_of(MACHINE_DONE);

    packet_add_byte(&packet, (uint8_t)board_reported_amplifier(&process->board));
    packet_add_byte(&packet, (uint8_t)board_reported_fault(&process->board));
    packet_add_byte(&packet, process->board.commanded ? 1u : 0u);
    packet_add_word(&packet, process->board.command_alive);
    packet_add_word(&packet, process->board.counter);
    packet_add_word(&packet, process->board.refused_commands);
    machine_send(process->machine, &packet);
}

static void run_lockstep(struct process *process)
{
    answer_done(process);
    for (;;) {
        uint8_t request[RECEIVE_HEAD + BUS_LONGEST];
        const size_t size = machine_receive(process->machine, request, sizeof(request));
        int64_t at_ns;
        uint32_t identifier;

        if (size >= 9u) {
            (void)memcpy(&at_ns, &request[1], 8u);
            if (request[0] == MACHINE_TICK) {
                sample(process, at_ns);
            } else if ((request[0] == MACHINE_RECEIVE) && (size >= RECEIVE_HEAD)) {
                (void)memcpy(&identifier, &request[9], 4u);
                (void)board_receive(&process->board, identifier, &request[RECEIVE_HEAD], size - RECEIVE_HEAD, at_ns);
            } else {
                /* Nothing else is asked. */
            }
        }
        answer_done(process);
    }
}

static void take_frames(struct process *process)
{
    struct bus_frame frame;

    for (int taken = 0; (taken < AT_ONCE) && bus_receive(&process->bus, &frame); taken++) {
        /* A command acts from its time on the bus, not from when this process read it. */
        const int64_t late_ns = clock_ns(CLOCK_REALTIME) - frame.sent_ns;
        const int64_t at_ns = clock_ns(CLOCK_MONOTONIC) - ((late_ns > 0) ? late_ns : 0);
        const bool taken_by_board =
            board_receive(&process->board, frame.identifier, frame.data, frame.length, at_ns);

        if (!taken_by_board && (frame.length <= 8u)) {
            struct packet packet = packet_of(MACHINE_STAGE);

            packet_add_time(&packet, at_ns);
            packet_add_word(&packet, frame.identifier);
            packet_add(&packet, frame.data, frame.length);
            machine_send(process->machine, &packet);
        }
    }
}

/* Wait for a frame, for the next sample, or for the next thing to do; end with the parent. */
static void wait_until(const struct process *process, int64_t until_ns)
{
    const int64_t left_ns = until_ns - clock_ns(CLOCK_MONOTONIC);
    const struct timespec left = {(time_t)((left_ns > 0) ? (left_ns / 1000000000) : 0),
                                  (long)((left_ns > 0) ? (left_ns % 1000000000) : 0)};
    struct pollfd watched[2] = {{.fd = process->machine, .events = POLLIN},
                                {.fd = process->bus.descriptor, .events = POLLIN}};

    (void)ppoll(watched, 2, &left, NULL);
    if ((watched[0].revents & (POLLHUP | POLLERR)) != 0) {
        exit(EXIT_SUCCESS);
    }
}

static void run_on_bus(struct process *process, int64_t lead_ns)
{
    for (;;) {
        const int64_t due_ns = board_next_ns(&process->board);
        const int64_t wake_ns = process->next_sample_ns - lead_ns;
        int64_t now_ns;

        wait_until(process, (due_ns < wake_ns) ? due_ns : wake_ns);
        bus_open_again(&process->bus);
        take_frames(process);
        now_ns = clock_ns(CLOCK_MONOTONIC);
        board_act(&process->board, now_ns);
        sample(process, now_ns + lead_ns);
    }
}

int main(int count, char **arguments)
{
    static struct process process;
    struct options options;

    if (!options_read(&options, count, arguments)) {
        return EXIT_FAILURE;
    }
    process.machine = (int)options.machine;
    process.lockstep = options.bus[0] == '\0';
    if (process.lockstep) {
        /* The first packet is the time of the first sample. */
        uint8_t first[9];

        if (machine_receive(process.machine, first, sizeof(first)) != sizeof(first)) {
            return EXIT_FAILURE;
        }
        (void)memcpy(&process.next_sample_ns, &first[1], 8u);
    } else {
        bus_start(&process.bus, options.bus, options.fd);
        process.next_sample_ns = clock_ns(CLOCK_MONOTONIC) + options.lead_ns;
    }
    if (!board_start(&process.board, &options.config, send_frame, drive, &process, process.next_sample_ns)) {
        (void)fprintf(stderr, "board_posix: the configuration is not allowed\n");
        return EXIT_FAILURE;
    }
    if (process.lockstep) {
        run_lockstep(&process);
    } else {
        run_on_bus(&process, options.lead_ns);
    }
}
