/* The frames of straightcomp.dbc, made by straightcomp: do not edit. */
#include "frames.h"
#include "wire.h"

/* Encoder */
static void pack_message_1(uint8_t *data, const struct wire_report *report, uint32_t page)
{
    const struct frames_message_1_t frame = {
        .alive = (uint8_t)report->alive,
        .amplifier = (uint8_t)((const uint32_t[]){1u, 1u, 2u, 3u})[report->amplifier],
        .fault = (uint8_t)((const uint32_t[]){0u, 1u, 2u, 3u, 4u, 5u, 6u, 7u})[report->fault],
        .good = (uint8_t)(report->good ? 1 : 0),
        .x = (int32_t)limited(scaled(report->scaling->x, report->x), INT64_C(-33554431), INT64_C(33554431)),
        .y = (int32_t)limited(scaled(report->scaling->y, report->y), INT64_C(-524287), INT64_C(524287)),
    };

    (void)page;
    (void)frames_message_1_pack(data, &frame, 8u);
}

/* CoilCurrent */
static void pack_message_2(uint8_t *data, const struct wire_report *report, uint32_t page)
{
    const struct frames_message_2_t frame = {
        .alive = (uint8_t)report->alive,
        .referenced = (uint8_t)(report->referenced ? 1 : 0),
        .current = (int16_t)nearest((limited_real(report->current, (board_real)-3.2767, (board_real)3.2767) / (board_real)0.0001)),
        .counter = (uint32_t)report->counter,
    };

    (void)page;
    (void)frames_message_2_pack(data, &frame, 8u);
}

/* Command */
static bool unpack_message_3(struct command *command, const uint8_t *data, size_t length)
{
    struct frames_message_3_t frame;
    bool known = frames_message_3_unpack(&frame, data, length) == 0;

    if (known) {
        command->current = (board_real)frame.current * (board_real)0.0001;
        command->given |= (uint8_t)COMMAND_CURRENT;
        command->enable = frame.enable == (uint8_t)2;
        command->given |= (uint8_t)COMMAND_ENABLE;
        command->reset = frame.reset == (uint8_t)2;
        command->given |= (uint8_t)COMMAND_RESET;
        command->echo = (uint32_t)frame.echo;
        command->given |= (uint8_t)COMMAND_ECHO;
        command->alive = (uint32_t)frame.alive;
        command->given |= (uint8_t)COMMAND_ALIVE;
        known = ((frame.enable == (uint8_t)1) || (frame.enable == (uint8_t)2)) && ((frame.reset == (uint8_t)1) || (frame.reset == (uint8_t)2)) && (frame.alive < 15u);
    }
    return known;
}

/* Heartbeat */
static void pack_message_4(uint8_t *data, bool boot_up)
{
    const struct frames_message_4_t frame = {
        .state = (uint8_t)(boot_up ? 0u : 5u),
    };

    (void)frames_message_4_pack(data, &frame, 1u);
}

static bool classic_fits(const struct wire_report *report)
{
    return (limited(scaled(report->scaling->x, report->x), INT64_C(-33554431), INT64_C(33554431)) == scaled(report->scaling->x, report->x)) && (limited(scaled(report->scaling->y, report->y), INT64_C(-524287), INT64_C(524287)) == scaled(report->scaling->y, report->y));
}

static const struct wire_frame classic_frames[] = {
    {
        .identifier = 0x181u,
        .length = 8u,
        .fd = false,
        .pages = 1u,
        .every = 1u,
        .alive_most = 14u,
        .protection = {.profile = PROTECTION_E2E_1, .place = 0u, .big_endian = false, .by_identifier = true},
        .pack = pack_message_1,
    },
    {
        .identifier = 0x281u,
        .length = 8u,
        .fd = false,
        .pages = 1u,
        .every = 10u,
        .alive_most = 14u,
        .protection = {.profile = PROTECTION_E2E_1, .place = 0u, .big_endian = false, .by_identifier = true},
        .pack = pack_message_2,
    },
};

static const struct wire_order classic_orders[] = {
    {
        .identifier = 0x201u,
        .length = 5u,
        .protection = {.profile = PROTECTION_E2E_1, .place = 0u, .big_endian = false, .by_identifier = true},
        .unpack = unpack_message_3,
    },
};

static const struct wire_heartbeat classic_heartbeat = {
    .identifier = 0x701u,
    .length = 1u,
    .fd = false,
    .period_ns = INT64_C(50000000),
    .pack = pack_message_4,
};

static const struct wire classic = {
    .source = "straightcomp.dbc 5d4b87876a5f",
    .frame_count = 2u,
    .order_count = 1u,
    .frames = classic_frames,
    .orders = classic_orders,
    .order_modulus = 0u,
    .counter_most = 4026531839u,
    .echoes = true,
    .echo_most = 255u,
    .heartbeat = &classic_heartbeat,
    .fits = classic_fits,
};

/* EncoderFd */
static void pack_message_5(uint8_t *data, const struct wire_report *report, uint32_t page)
{
    const struct frames_message_5_t frame = {
        .alive = (uint8_t)report->alive,
        .amplifier = (uint8_t)((const uint32_t[]){1u, 1u, 2u, 3u})[report->amplifier],
        .fault = (uint8_t)((const uint32_t[]){0u, 1u, 2u, 3u, 4u, 5u, 6u, 7u})[report->fault],
        .good = (uint8_t)(report->good ? 1 : 0),
        .x = (int32_t)limited(scaled(report->scaling->x, report->x), INT64_C(-33554431), INT64_C(33554431)),
        .y = (int32_t)limited(scaled(report->scaling->y, report->y), INT64_C(-524287), INT64_C(524287)),
        .current = (int16_t)nearest((limited_real(report->current, (board_real)-3.2767, (board_real)3.2767) / (board_real)0.0001)),
        .counter = (uint32_t)report->counter,
        .referenced = (uint8_t)(report->referenced ? 1 : 0),
    };

    (void)page;
    (void)frames_message_5_pack(data, &frame, 16u);
}

/* CommandFd */
static bool unpack_message_6(struct command *command, const uint8_t *data, size_t length)
{
    struct frames_message_6_t frame;
    bool known = frames_message_6_unpack(&frame, data, length) == 0;

    if (known) {
        command->current = (board_real)frame.current * (board_real)0.0001;
        command->given |= (uint8_t)COMMAND_CURRENT;
        command->enable = frame.enable == (uint8_t)2;
        command->given |= (uint8_t)COMMAND_ENABLE;
        command->reset = frame.reset == (uint8_t)2;
        command->given |= (uint8_t)COMMAND_RESET;
        command->echo = (uint32_t)frame.echo;
        command->given |= (uint8_t)COMMAND_ECHO;
        command->alive = (uint32_t)frame.alive;
        command->given |= (uint8_t)COMMAND_ALIVE;
        known = ((frame.enable == (uint8_t)1) || (frame.enable == (uint8_t)2)) && ((frame.reset == (uint8_t)1) || (frame.reset == (uint8_t)2)) && (frame.alive < 15u);
    }
    return known;
}

static bool fd_fits(const struct wire_report *report)
{
    return (limited(scaled(report->scaling->x, report->x), INT64_C(-33554431), INT64_C(33554431)) == scaled(report->scaling->x, report->x)) && (limited(scaled(report->scaling->y, report->y), INT64_C(-524287), INT64_C(524287)) == scaled(report->scaling->y, report->y));
}

static const struct wire_frame fd_frames[] = {
    {
        .identifier = 0x381u,
        .length = 16u,
        .fd = true,
        .pages = 1u,
        .every = 1u,
        .alive_most = 14u,
        .protection = {.profile = PROTECTION_E2E_1, .place = 0u, .big_endian = false, .by_identifier = true},
        .pack = pack_message_5,
    },
};

static const struct wire_order fd_orders[] = {
    {
        .identifier = 0x301u,
        .length = 8u,
        .protection = {.profile = PROTECTION_E2E_1, .place = 0u, .big_endian = false, .by_identifier = true},
        .unpack = unpack_message_6,
    },
};

static const struct wire_heartbeat fd_heartbeat = {
    .identifier = 0x701u,
    .length = 1u,
    .fd = false,
    .period_ns = INT64_C(50000000),
    .pack = pack_message_4,
};

static const struct wire fd = {
    .source = "straightcomp.dbc 6ad17dd203a9",
    .frame_count = 1u,
    .order_count = 1u,
    .frames = fd_frames,
    .orders = fd_orders,
    .order_modulus = 0u,
    .counter_most = 4026531839u,
    .echoes = true,
    .echo_most = 4026531839u,
    .heartbeat = &fd_heartbeat,
    .fits = fd_fits,
};

const struct wire *const wire_classic = &classic;
const struct wire *const wire_fd = &fd;
