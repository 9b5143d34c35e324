#include "options.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum kind { WHOLE, REAL, TEXT };

/* Where the value of an argument is put before it gets its own type: every argument is needed once. */
struct argument {
    const char *name;
    enum kind kind;
    int64_t whole;
    double real;
    const char *text;
    bool given;
};

enum {
    MACHINE, BUS, LEAD, NODE, FD, SOURCE, PERIOD, DELAY, CURRENT_LIMIT, X_NUMERATOR, X_DENOMINATOR, Y_NUMERATOR,
    Y_DENOMINATOR, TIMEOUT, HOLD_AFTER, HALF_CODES, CODE_CURRENT, WEIGHT, KEPT, BRAKING, STIFFNESS, X_COUNT, Y_COUNT,
    ARGUMENTS
};

static bool read_value(struct argument *argument, const char *text)
{
    char *end = NULL;

    errno = 0;
    if (argument->kind == WHOLE) {
        argument->whole = strtoll(text, &end, 10);
    } else if (argument->kind == REAL) {
        argument->real = strtod(text, &end);
    } else {
        argument->text = text;
    }
    argument->given = (end == NULL) || ((end != text) && (*end == '\0') && (errno == 0));
    return argument->given;
}

static bool read_argument(struct argument *arguments, const char *text)
{
    for (int i = 0; i < (int)ARGUMENTS; i++) {
        const size_t length = strlen(arguments[i].name);

        if ((strncmp(text, arguments[i].name, length) == 0) && (text[length] == '=')) {
            return read_value(&arguments[i], &text[length + 1u]);
        }
    }
    return false;
}

/* The frames of this kind of bus, if they were made from what the host has; NULL, with a message, if not. */
static const struct wire *wire_made_from(const char *source, bool fd)
{
    const struct wire *own = fd ? wire_fd : wire_classic;
    const bool right = (own != NULL) && (strcmp(own->source, source) == 0);

    if (!right) {
        (void)fprintf(stderr,
                      "board_posix: built with the frames of '%s', not with those of '%s' on %s; straightcomp can "
                      "firmware makes them from a stage file\n",
                      (own != NULL) ? own->source : "another kind of bus", source, fd ? "CAN FD" : "classic CAN");
    }
    return right ? own : NULL;
}

bool options_read(struct options *options, int count, char **arguments)
{
    struct argument known[ARGUMENTS] = {
        [MACHINE] = {.name = "machine"},
        [BUS] = {.name = "bus", .kind = TEXT},
        [LEAD] = {.name = "lead_ns"},
        [NODE] = {.name = "node"},
        [FD] = {.name = "fd"},
        [SOURCE] = {.name = "source", .kind = TEXT},
        [PERIOD] = {.name = "period_ns"},
        [DELAY] = {.name = "delay_ns"},
        [CURRENT_LIMIT] = {.name = "current_limit", .kind = REAL},
        [X_NUMERATOR] = {.name = "x_numerator"},
        [X_DENOMINATOR] = {.name = "x_denominator"},
        [Y_NUMERATOR] = {.name = "y_numerator"},
        [Y_DENOMINATOR] = {.name = "y_denominator"},
        [TIMEOUT] = {.name = "command_timeout_ns"},
        [HOLD_AFTER] = {.name = "hold_after_ns"},
        [HALF_CODES] = {.name = "half_codes"},
        [CODE_CURRENT] = {.name = "code_current", .kind = REAL},
        [WEIGHT] = {.name = "hold_weight", .kind = REAL},
        [KEPT] = {.name = "hold_kept", .kind = REAL},
        [BRAKING] = {.name = "hold_braking", .kind = REAL},
        [STIFFNESS] = {.name = "hold_stiffness", .kind = REAL},
        [X_COUNT] = {.name = "x_count", .kind = REAL},
        [Y_COUNT] = {.name = "y_count", .kind = REAL},
    };

    for (int i = 1; i < count; i++) {
        if (!read_argument(known, arguments[i])) {
            (void)fprintf(stderr, "board_posix: argument '%s' is not known, or no number\n", arguments[i]);
            return false;
        }
    }
    for (int i = 0; i < (int)ARGUMENTS; i++) {
        if (!known[i].given) {
            (void)fprintf(stderr, "board_posix: argument %s=... is missing\n", known[i].name);
            return false;
        }
    }
    options->machine = known[MACHINE].whole;
    options->bus = known[BUS].text;
    options->lead_ns = known[LEAD].whole;
    options->config.node = (uint8_t)known[NODE].whole;
    options->fd = known[FD].whole != 0;
    options->config.wire = wire_made_from(known[SOURCE].text, options->fd);
    options->config.period_ns = known[PERIOD].whole;
    options->config.delay_ns = known[DELAY].whole;
    options->config.current_limit = (board_real)known[CURRENT_LIMIT].real;
    options->config.scaling.x.numerator = (int32_t)known[X_NUMERATOR].whole;
    options->config.scaling.x.denominator = (int32_t)known[X_DENOMINATOR].whole;
    options->config.scaling.y.numerator = (int32_t)known[Y_NUMERATOR].whole;
    options->config.scaling.y.denominator = (int32_t)known[Y_DENOMINATOR].whole;
    options->config.scaling.x_count = (board_real)known[X_COUNT].real;
    options->config.scaling.y_count = (board_real)known[Y_COUNT].real;
    options->config.output.command_timeout_ns = known[TIMEOUT].whole;
    options->config.output.hold_after_ns = known[HOLD_AFTER].whole;
    options->config.output.half_codes = (int32_t)known[HALF_CODES].whole;
    options->config.output.code_current = (board_real)known[CODE_CURRENT].real;
    options->config.output.hold_weight = (board_real)known[WEIGHT].real;
    options->config.output.hold_kept = (board_real)known[KEPT].real;
    options->config.output.hold_braking = (board_real)known[BRAKING].real;
    options->config.output.hold_stiffness = (board_real)known[STIFFNESS].real;
    options->config.output.y_count = (board_real)known[Y_COUNT].real;
    return options->config.wire != NULL;
}
