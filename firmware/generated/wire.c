/* The frames of straightcomp.dbc, made by straightcomp: do not edit. */
#include "frames.h"
#include "wire.h"

static void pack_encoder(uint8_t *data, const struct wire_report *report, uint32_t page)
{
    const struct frames_encoder_t frame = {
        .encoder_alive = (uint8_t)report->alive,
        .amplifier = (uint8_t)((const uint32_t[]){1u, 1u, 2u, 3u})[report->amplifier],
        .board_fault = (uint8_t)((const uint32_t[]){0u, 1u, 2u, 3u, 4u, 5u, 6u, 7u})[report->fault],
        .encoders_valid = (uint8_t)(report->good ? 1 : 0),
        .stage_x = (int32_t)limited(scaled(report->scaling->x, report->x), INT64_C(-33554431), INT64_C(33554431)),
        .platform_y = (int32_t)limited(scaled(report->scaling->y, report->y), INT64_C(-524287), INT64_C(524287)),
    };

    (void)page;
    (void)frames_encoder_pack(data, &frame, 8u);
}

static void pack_coil_current(uint8_t *data, const struct wire_report *report, uint32_t page)
{
    const struct frames_coil_current_t frame = {
        .coil_current_alive = (uint8_t)report->alive,
        .referenced = (uint8_t)(report->referenced ? 1 : 0),
        .measured_current = (int16_t)nearest((limited_real(report->current, (board_real)-3.2767, (board_real)3.2767) / (board_real)0.0001)),
        .sample_counter = (uint32_t)report->counter,
    };

    (void)page;
    (void)frames_coil_current_pack(data, &frame, 8u);
}

static bool unpack_command(struct command *command, const uint8_t *data, size_t length)
{
    struct frames_command_t frame;
    bool known = frames_command_unpack(&frame, data, length) == 0;

    if (known) {
        command->current = (board_real)frame.control_current * (board_real)0.0001;
        command->given |= (uint8_t)COMMAND_CURRENT;
        command->enable = frame.enable == (uint8_t)2;
        command->given |= (uint8_t)COMMAND_ENABLE;
        command->reset = frame.reset_fault == (uint8_t)2;
        command->given |= (uint8_t)COMMAND_RESET;
        command->echo = (uint32_t)frame.echoed_counter;
        command->given |= (uint8_t)COMMAND_ECHO;
        command->alive = (uint32_t)frame.command_alive;
        command->given |= (uint8_t)COMMAND_ALIVE;
        known = ((frame.enable == (uint8_t)1) || (frame.enable == (uint8_t)2)) && ((frame.reset_fault == (uint8_t)1) || (frame.reset_fault == (uint8_t)2)) && (frame.command_alive < 15u);
    }
    return known;
}

static void pack_heartbeat(uint8_t *data, bool boot_up)
{
    const struct frames_heartbeat_t frame = {
        .node_state = (uint8_t)(boot_up ? 0u : 5u),
    };

    (void)frames_heartbeat_pack(data, &frame, 1u);
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
        .pack = pack_encoder,
    },
    {
        .identifier = 0x281u,
        .length = 8u,
        .fd = false,
        .pages = 1u,
        .every = 10u,
        .alive_most = 14u,
        .protection = {.profile = PROTECTION_E2E_1, .place = 0u, .big_endian = false, .by_identifier = true},
        .pack = pack_coil_current,
    },
};

static const struct wire_order classic_orders[] = {
    {
        .identifier = 0x201u,
        .length = 5u,
        .protection = {.profile = PROTECTION_E2E_1, .place = 0u, .big_endian = false, .by_identifier = true},
        .unpack = unpack_command,
    },
};

static const struct wire_heartbeat classic_heartbeat = {
    .identifier = 0x701u,
    .length = 1u,
    .fd = false,
    .period_ns = INT64_C(50000000),
    .pack = pack_heartbeat,
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

static void pack_encoder_fd(uint8_t *data, const struct wire_report *report, uint32_t page)
{
    const struct frames_encoder_fd_t frame = {
        .encoder_alive = (uint8_t)report->alive,
        .amplifier = (uint8_t)((const uint32_t[]){1u, 1u, 2u, 3u})[report->amplifier],
        .board_fault = (uint8_t)((const uint32_t[]){0u, 1u, 2u, 3u, 4u, 5u, 6u, 7u})[report->fault],
        .encoders_valid = (uint8_t)(report->good ? 1 : 0),
        .stage_x = (int32_t)limited(scaled(report->scaling->x, report->x), INT64_C(-33554431), INT64_C(33554431)),
        .platform_y = (int32_t)limited(scaled(report->scaling->y, report->y), INT64_C(-524287), INT64_C(524287)),
        .measured_current = (int16_t)nearest((limited_real(report->current, (board_real)-3.2767, (board_real)3.2767) / (board_real)0.0001)),
        .sample_counter = (uint32_t)report->counter,
        .referenced = (uint8_t)(report->referenced ? 1 : 0),
    };

    (void)page;
    (void)frames_encoder_fd_pack(data, &frame, 16u);
}

static bool unpack_command_fd(struct command *command, const uint8_t *data, size_t length)
{
    struct frames_command_fd_t frame;
    bool known = frames_command_fd_unpack(&frame, data, length) == 0;

    if (known) {
        command->current = (board_real)frame.control_current * (board_real)0.0001;
        command->given |= (uint8_t)COMMAND_CURRENT;
        command->enable = frame.enable == (uint8_t)2;
        command->given |= (uint8_t)COMMAND_ENABLE;
        command->reset = frame.reset_fault == (uint8_t)2;
        command->given |= (uint8_t)COMMAND_RESET;
        command->echo = (uint32_t)frame.echoed_counter;
        command->given |= (uint8_t)COMMAND_ECHO;
        command->alive = (uint32_t)frame.command_alive;
        command->given |= (uint8_t)COMMAND_ALIVE;
        known = ((frame.enable == (uint8_t)1) || (frame.enable == (uint8_t)2)) && ((frame.reset_fault == (uint8_t)1) || (frame.reset_fault == (uint8_t)2)) && (frame.command_alive < 15u);
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
        .pack = pack_encoder_fd,
    },
};

static const struct wire_order fd_orders[] = {
    {
        .identifier = 0x301u,
        .length = 8u,
        .protection = {.profile = PROTECTION_E2E_1, .place = 0u, .big_endian = false, .by_identifier = true},
        .unpack = unpack_command_fd,
    },
};

static const struct wire_heartbeat fd_heartbeat = {
    .identifier = 0x701u,
    .length = 1u,
    .fd = false,
    .period_ns = INT64_C(50000000),
    .pack = pack_heartbeat,
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
