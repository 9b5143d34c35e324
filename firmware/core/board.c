#include "board.h"

#include "command.h"
#include "report.h"
#include "wire.h"
#include "wire_limits.h"

#define STRIKE (4u)
#define STRIKE_LIMIT (16u)
/* Samples: the oldest that the eight bits of a classic frame distinguish from a future one. */
#define OLDEST_CLASSIC_ECHO ((WIRE_ECHO_MODULUS * 4u) / 5u)

static bool scale_allowed(struct scale scale)
{
    return (scale.numerator != 0) && (scale.denominator > 0);
}

static bool config_allowed(const struct board_config *config)
{
    const struct output_config *output = &config->output;
    const bool bus = (config->node >= 1u) && (config->node <= 127u);
    const bool times = (config->period_ns > 0) && (config->delay_ns >= 0) && (output->command_timeout_ns > 0) &&
                       (output->hold_after_ns > 0);
    const bool currents = (config->current_limit > 0) && (output->half_codes > 0) &&
                          (output->code_current > (board_real)0);

    return bus && times && currents && scale_allowed(config->x) && scale_allowed(config->y) &&
           scale_allowed(config->current);
}

bool board_start(struct board *board, const struct board_config *config, board_send_t send, output_drive_t drive,
                 void *context, int64_t now_ns)
{
    const bool allowed = config_allowed(config);

    if (allowed) {
        const int64_t oldest = config->output.command_timeout_ns / config->period_ns;
        const uint32_t most_echoes = config->fd ? (WIRE_COUNTER_MODULUS - 1u) : OLDEST_CLASSIC_ECHO;
        const int64_t most = (int64_t)most_echoes;
        const struct board started = {
            .config = *config,
            .send = send,
            .context = context,
            .fault = BOARD_FAULT_NONE,
            .command_alive = COMMAND_NO_ALIVE,
            /* An answer to a sample older than the timeout counts as no answer. */
            .oldest_echo = (uint32_t)((oldest < most) ? oldest : most),
            /* The first sample is yet to come: what is commanded before it waits for none. */
            .newest_ns = now_ns - config->period_ns,
            .next_heartbeat_ns = now_ns,
        };

        *board = started;
        output_start(&board->output, &board->config.output, drive, context, now_ns);
        report_boot_up(board);
    }
    return allowed;
}

enum board_amplifier board_reported_amplifier(const struct board *board)
{
    enum board_amplifier amplifier = BOARD_AMPLIFIER_OFF;

    if (board_reported_fault(board) != BOARD_FAULT_NONE) {
        amplifier = BOARD_AMPLIFIER_FAULT;
    } else if (board->output.on) {
        amplifier = BOARD_AMPLIFIER_ON;
    } else {
        /* Off. */
    }
    return amplifier;
}

enum board_fault board_reported_fault(const struct board *board)
{
    enum board_fault fault = board->fault;

    if ((fault == BOARD_FAULT_NONE) && board->output.timed_out) {
        fault = BOARD_FAULT_COMMAND_TIMEOUT;
    }
    return fault;
}

static void switch_off_with(struct board *board, enum board_fault fault)
{
    board->fault = fault;
    output_switch_off(&board->output);
    board->seen_off = false;
}

void board_trip(struct board *board, enum board_fault fault)
{
    switch_off_with(board, fault);
}

/* A fault of the commands: with the amplifier off there is nothing to protect, and nothing is latched. */
static void trip_by_command(struct board *board, enum board_fault fault)
{
    switch_off_with(board, board->output.on ? fault : board->fault);
}

static void strike(struct board *board)
{
    board->refused_commands++;
    board->strikes += (uint8_t)STRIKE;
    if (board->strikes >= STRIKE_LIMIT) {
        board->strikes = (uint8_t)STRIKE_LIMIT;
        trip_by_command(board, BOARD_FAULT_COMMAND_CHECK);
    }
}

/* How many samples ago the one was taken that a command answers. */
static uint32_t age_of(const struct board *board, uint32_t echo)
{
    /* An echo beyond the counter's modulus is no number of a sample; the remainder makes it an old or a new one. */
    const uint32_t modulus = board->config.fd ? WIRE_COUNTER_MODULUS : WIRE_ECHO_MODULUS;
    const uint32_t newest = board->counter % modulus;
    const uint32_t answered = echo % modulus;
    uint32_t age = modulus - (answered - newest);

    if (newest >= answered) {
        age = newest - answered;
    }
    return age;
}

static void switch_off_by_command(struct board *board, const struct command *command)
{
    /* "Off" is obeyed from any frame that passes its checks, even an old one. */
    board->seen_off = true;
    output_switch_off(&board->output);
    if (command->reset) {
        output_reset(&board->output);
        board->fault = BOARD_FAULT_NONE;
        board->strikes = 0u;
    }
}

static void apply(struct board *board, const struct command *command, uint32_t age, int64_t at_ns)
{
    const int64_t due_ns = (board->newest_ns - ((int64_t)age * board->config.period_ns)) + board->config.delay_ns;

    if (command->enable && board->seen_off && (board_reported_amplifier(board) == BOARD_AMPLIFIER_OFF)) {
        /* Only an edge from off to on switches on, so a host that goes on saying "on" after a fault has no effect. */
        output_switch_on(&board->output);
    }
    board->seen_off = board->seen_off && !command->enable;
    if (!output_command(&board->output, command->current, (at_ns > due_ns) ? at_ns : due_ns)) {
        board->refused_commands++;
    }
}

static void obey(struct board *board, const struct command *command, int64_t at_ns)
{
    const bool repeated = command->alive == board->command_alive;
    const uint32_t age = age_of(board, command->echo);

    if (!command->enable) {
        switch_off_by_command(board, command);
    }
    board->command_alive = command->alive;
    if (repeated || (age > board->oldest_echo)) {
        board->refused_commands++;
    } else {
        if (board->strikes > 0u) {
            board->strikes--;
        }
        if ((command->current > board->config.current_limit) || (command->current < -board->config.current_limit)) {
            trip_by_command(board, BOARD_FAULT_CURRENT_RANGE);
        } else {
            apply(board, command, age, at_ns);
        }
    }
}

bool board_receive(struct board *board, uint32_t identifier, const uint8_t *data, size_t length, int64_t at_ns)
{
    const uint32_t own = board->config.fd ? WIRE_COMMAND_FD_FRAME_ID : WIRE_COMMAND_FRAME_ID;
    const bool for_this_board = identifier == report_identifier(board, own);

    if (for_this_board) {
        struct command command;

        if (command_checked(&command, board->config.fd, identifier, data, length)) {
            obey(board, &command, at_ns);
        } else {
            strike(board);
        }
    }
    return for_this_board;
}

void board_act(struct board *board, int64_t now_ns)
{
    output_act(&board->output, now_ns);
}

int64_t board_next_ns(const struct board *board)
{
    return output_next_ns(&board->output);
}

void board_sample(struct board *board, int64_t now_ns, const struct board_reading *reading)
{
    output_act(&board->output, now_ns);
    output_sample(&board->output, now_ns, reading->y);
    board->newest_ns = now_ns;
    board->counter = board->sampled ? ((board->counter + 1u) % WIRE_COUNTER_MODULUS) : 0u;
    board->sampled = true;
    report_sample(board, now_ns, reading);
}
