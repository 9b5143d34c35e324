#include "board.h"

#include "report.h"

#define STRIKE (4u)
#define STRIKE_LIMIT (16u)

static bool scale_allowed(struct scale scale)
{
    return (scale.numerator != 0) && (scale.denominator > 0);
}

static bool config_allowed(const struct board_config *config)
{
    const struct output_config *output = &config->output;
    const bool bus = (config->wire != NULL) && (config->wire->frame_count <= WIRE_FRAMES) && (config->node >= 1u) &&
                     (config->node <= 127u);
    const bool times = (config->period_ns > 0) && (config->delay_ns >= 0) && (output->command_timeout_ns > 0) &&
                       (output->hold_after_ns > 0);
    const bool currents = (config->current_limit > (board_real)0) && (output->half_codes > 0) &&
                          (output->code_current > (board_real)0);

    return bus && times && currents && scale_allowed(config->scaling.x) && scale_allowed(config->scaling.y);
}

bool board_start(struct board *board, const struct board_config *config, board_send_t send, output_drive_t drive,
                 void *context, int64_t now_ns)
{
    const bool allowed = config_allowed(config);

    if (allowed) {
        const struct wire *wire = config->wire;
        const int64_t oldest = config->output.command_timeout_ns / config->period_ns;
        /* An older one cannot be told from one that is yet to come. */
        const int64_t most = wire->echoes ? ((((int64_t)wire->echo_most + 1) * 4) / 5) : 0;
        const struct board started = {
            .config = *config,
            .send = send,
            .context = context,
            .fault = BOARD_FAULT_NONE,
            /* An answer to a sample older than the timeout counts as no answer. */
            .oldest_echo = (uint32_t)((oldest < most) ? oldest : most),
            /* The first sample is yet to come: what is commanded before it waits for none. */
            .newest_ns = now_ns - config->period_ns,
            .next_heartbeat_ns = now_ns,
        };

        *board = started;
        output_start(&board->output, &board->config.output, drive, context, now_ns);
        command_sets_start(&board->commands, wire->order_count, wire->order_modulus, config->period_ns);
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

/* The remainder of a count that begins again after `most`. */
static uint32_t wrapped(uint32_t count, uint32_t most)
{
    return (most == UINT32_MAX) ? count : (count % (most + 1u));
}

/* How many samples ago the one was taken that a command answers. */
static uint32_t age_of(const struct board *board, const struct command *command)
{
    uint32_t age = 0u;

    if (board->config.wire->echoes) {
        /* An echo beyond its modulus is no number of a sample; the remainder makes it an old or a new one. */
        const uint32_t most = board->config.wire->echo_most;
        const uint32_t newest = wrapped(board->counter, most);
        const uint32_t answered = wrapped(command->echo, most);

        age = newest - answered;
        if (newest < answered) {
            age = (most - (answered - newest)) + 1u;
        }
    }
    return age;
}

static void switch_off_by_command(struct board *board)
{
    /* "Off" is obeyed from any frame that passes its checks, even an old one, or one whose others do not come. */
    board->seen_off = true;
    output_switch_off(&board->output);
}

static void reset_by_command(struct board *board)
{
    output_reset(&board->output);
    board->fault = BOARD_FAULT_NONE;
    board->strikes = 0u;
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
    const bool counts = (command->given & COMMAND_ALIVE) != 0u;
    const bool repeated = counts && board->commanded && (command->alive == board->command_alive);
    const bool may_reset = command->reset || ((command->given & COMMAND_RESET) == 0u);
    const uint32_t age = age_of(board, command);

    if (!command->enable && may_reset) {
        /* Where no signal asks for it, each "off" resets. */
        reset_by_command(board);
    }
    board->commanded = counts;
    board->command_alive = command->alive;
    if (repeated || (age > board->oldest_echo)) {
        board->refused_commands++;
    } else {
        if (board->strikes > 0u) {
            board->strikes--;
        }
        const board_real limit = board->config.current_limit;

        /* A comparison with what is no number is false. */
        if (!((command->current >= -limit) && (command->current <= limit))) {
            trip_by_command(board, BOARD_FAULT_CURRENT_RANGE);
        } else {
            apply(board, command, age, at_ns);
        }
    }
}

/* Take a command, or a part of one whose other signals come in other messages. */
static void hear(struct board *board, uint8_t part, struct command *command, int64_t at_ns)
{
    enum command_part result = COMMAND_WHOLE;

    if (((command->given & COMMAND_ENABLE) != 0u) && !command->enable) {
        switch_off_by_command(board);
    }
    if (board->config.wire->order_count > 1u) {
        result = command_sets_add(&board->commands, part, command, at_ns);
    }
    if (result == COMMAND_WHOLE) {
        obey(board, command, at_ns);
    } else if (result == COMMAND_REPEATED) {
        board->refused_commands++;
    } else {
        /* The others are yet to come. */
    }
}

bool board_receive(struct board *board, uint32_t identifier, const uint8_t *data, size_t length, int64_t at_ns)
{
    const struct wire *wire = board->config.wire;
    bool for_this_board = false;

    for (uint8_t part = 0u; part < wire->order_count; part++) {
        const struct wire_order *order = &wire->orders[part];

        if (identifier == report_identifier(board, order->identifier)) {
            struct command command = {0};

            for_this_board = true;
            if ((length == order->length) && order->unpack(&command, data, length) &&
                protection_right(&order->protection, identifier, command.alive, data, length)) {
                hear(board, part, &command, at_ns);
            } else {
                strike(board);
            }
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
    if (!reading->referenced && board->output.on) {
        /* A wrong x must not be compensated for the time until the host has seen it. */
        board_trip(board, BOARD_FAULT_ENCODER);
    }
    board->newest_ns = now_ns;
    board->counter = board->next_counter;
    board->next_counter = (board->counter >= board->config.wire->counter_most) ? 0u : (board->counter + 1u);
    report_sample(board, now_ns, reading);
}
