#include "output.h"

#include "scale.h"

void output_start(struct output *output, const struct output_config *config, output_drive_t drive, void *context,
                  int64_t now_ns)
{
    const struct output started = {
        .config = config,
        .drive = drive,
        .context = context,
        .now_ns = now_ns,
        .last_command_ns = now_ns,
        .hold_at_ns = OUTPUT_NEVER,
    };

    *output = started;
    drive(context, now_ns, false, 0);
}

/* The code of the D/A converter nearest to a current in A. */
static int32_t nearest_code(const struct output_config *config, board_real current)
{
    const board_real limit = (board_real)config->half_codes;

    /* The range first: a conversion of what does not fit is undefined. */
    return nearest(limited_real(current / config->code_current, -limit, limit - (board_real)1));
}

static board_real current_of(const struct output *output)
{
    return (board_real)output->code * output->config->code_current;
}

static void set_code(struct output *output, int64_t at_ns, int32_t code)
{
    output->code = code;
    output->drive(output->context, at_ns, true, code);
}

/* The impulse after one more sample with the present current, of which friction leaves a share. */
static void count_impulse(struct output *output)
{
    output->impulse = output->config->hold_kept * (output->impulse + (current_of(output) - output->mean));
}

static int32_t holding_code(const struct output *output)
{
    const struct output_config *config = output->config;
    const int64_t moved = (int64_t)output->reading - output->anchor;
    const board_real displacement = (board_real)moved * config->y_count;
    const board_real braking = config->hold_braking * output->impulse;

    return nearest_code(config, output->mean - braking - (config->hold_stiffness * displacement));
}

static void take_effect(struct output *output, const struct output_command *command)
{
    const struct output_config *config = output->config;

    if (output->on) {
        set_code(output, command->at_ns, nearest_code(config, command->current));
        output->mean += config->hold_weight * (current_of(output) - output->mean);
        output->hold_at_ns = command->at_ns + config->hold_after_ns;
        output->holding = false;
    }
}

static void begin_to_hold(struct output *output)
{
    const int64_t at_ns = output->hold_at_ns;

    /* The last command fought the error of its own moment; held for longer it drives the platform away. */
    output->hold_at_ns = OUTPUT_NEVER;
    output->holding = true;
    output->anchor = output->reading;
    count_impulse(output);
    set_code(output, at_ns, holding_code(output));
}

bool output_command(struct output *output, board_real current, int64_t at_ns)
{
    const bool room = output->waiting_count < OUTPUT_WAITING;

    if (room) {
        int64_t effective_ns = (at_ns > output->now_ns) ? at_ns : output->now_ns;
        struct output_command *place;

        if (output->waiting_count > 0u) {
            const unsigned int last = ((unsigned int)output->first + output->waiting_count - 1u) % OUTPUT_WAITING;

            /* In the order in which they came. */
            if (output->waiting[last].at_ns > effective_ns) {
                effective_ns = output->waiting[last].at_ns;
            }
        }
        place = &output->waiting[((unsigned int)output->first + output->waiting_count) % OUTPUT_WAITING];
        place->at_ns = effective_ns;
        place->current = current;
        output->waiting_count++;
        output->last_command_ns = effective_ns;
    }
    return room;
}

int64_t output_next_ns(const struct output *output)
{
    int64_t next_ns = output->hold_at_ns;

    if ((output->waiting_count > 0u) && (output->waiting[output->first].at_ns <= next_ns)) {
        next_ns = output->waiting[output->first].at_ns;
    }
    return next_ns;
}

void output_act(struct output *output, int64_t now_ns)
{
    int64_t next_ns = output_next_ns(output);

    while ((next_ns != OUTPUT_NEVER) && (next_ns <= now_ns)) {
        const struct output_command *oldest = &output->waiting[output->first];

        if ((output->waiting_count > 0u) && (oldest->at_ns == next_ns)) {
            output->first = (uint8_t)((output->first + 1u) % OUTPUT_WAITING);
            output->waiting_count--;
            take_effect(output, oldest);
        } else {
            begin_to_hold(output);
        }
        next_ns = output_next_ns(output);
    }
}

void output_sample(struct output *output, int64_t now_ns, int32_t y_reading)
{
    output->now_ns = now_ns;
    output->reading = y_reading;
    count_impulse(output);
    if (output->holding) {
        set_code(output, now_ns, holding_code(output));
    }
    if (output->on && ((now_ns - output->last_command_ns) > output->config->command_timeout_ns)) {
        output_switch_off(output);
        output->timed_out = true;
    }
}

void output_switch_on(struct output *output)
{
    if (!output->on && !output->timed_out) {
        output->on = true;
        if (output->last_command_ns < output->now_ns) {
            output->last_command_ns = output->now_ns;
        }
        set_code(output, output->now_ns, 0);
    }
}

void output_switch_off(struct output *output)
{
    output->on = false;
    output->waiting_count = 0u;
    output->hold_at_ns = OUTPUT_NEVER;
    output->holding = false;
    output->code = 0;
    output->mean = (board_real)0;
    output->impulse = (board_real)0;
    output->drive(output->context, output->now_ns, false, 0);
}

void output_reset(struct output *output)
{
    output->timed_out = false;
}
