#include "report.h"

#include "crc8.h"
#include "wire.h"
#include "wire_limits.h"

#define BOOT_UP ((uint8_t)WIRE_HEARTBEAT_NODE_STATE_BOOT_UP_CHOICE)
#define OPERATIONAL ((uint8_t)WIRE_HEARTBEAT_NODE_STATE_OPERATIONAL_CHOICE)

uint32_t report_identifier(const struct board *board, uint32_t of_node_1)
{
    return of_node_1 + board->config.node - 1u;
}

static void send_heartbeat(struct board *board, uint8_t state)
{
    const struct wire_heartbeat_t heartbeat = {.node_state = state};
    uint8_t data[WIRE_HEARTBEAT_LENGTH];

    (void)wire_heartbeat_pack(data, &heartbeat, sizeof(data));
    board->send(board->context, report_identifier(board, WIRE_HEARTBEAT_FRAME_ID), false, data, sizeof(data));
}

/* Writes the CRC into the first byte and sends. */
static void send_sealed(struct board *board, uint32_t of_node_1, bool fd, uint8_t *data, size_t length)
{
    const uint32_t identifier = report_identifier(board, of_node_1);

    data[0] = crc8_of_frame((uint16_t)identifier, data, length);
    board->send(board->context, identifier, fd, data, length);
}

static int32_t limited(int64_t value, int32_t limit)
{
    int64_t within = value;

    if (value > limit) {
        within = limit;
    } else if (value < -limit) {
        within = -limit;
    } else {
        /* It fits. */
    }
    return (int32_t)within;
}

static int16_t measured_current(const struct board *board, int32_t counts)
{
    return board->output.on ? (int16_t)limited(scaled(board->config.current, counts), WIRE_CURRENT_LIMIT) : 0;
}

static void send_encoder(struct board *board, const struct board_reading *reading, int16_t current)
{
    const int64_t read_x = scaled(board->config.x, reading->x);
    const int64_t read_y = scaled(board->config.y, reading->y);
    const int32_t x = limited(read_x, WIRE_X_LIMIT);
    const int32_t y = limited(read_y, WIRE_Y_LIMIT);
    const bool valid = reading->valid && (x == read_x) && (y == read_y);
    const struct wire_encoder_fd_t frame = {
        .encoder_alive = (uint8_t)(board->counter % WIRE_ALIVE_MODULUS),
        .amplifier = (uint8_t)board_reported_amplifier(board),
        .board_fault = (uint8_t)board_reported_fault(board),
        .encoders_valid = valid ? 1u : 0u,
        .stage_x = x,
        .platform_y = y,
        .measured_current = current,
        .sample_counter = board->counter,
    };
    const struct wire_encoder_t classic = {
        .encoder_alive = frame.encoder_alive,
        .amplifier = frame.amplifier,
        .board_fault = frame.board_fault,
        .encoders_valid = frame.encoders_valid,
        .stage_x = frame.stage_x,
        .platform_y = frame.platform_y,
    };
    uint8_t data[WIRE_ENCODER_FD_LENGTH];

    if (board->config.fd) {
        (void)wire_encoder_fd_pack(data, &frame, sizeof(data));
        send_sealed(board, WIRE_ENCODER_FD_FRAME_ID, true, data, WIRE_ENCODER_FD_LENGTH);
    } else {
        (void)wire_encoder_pack(data, &classic, sizeof(data));
        send_sealed(board, WIRE_ENCODER_FRAME_ID, false, data, WIRE_ENCODER_LENGTH);
    }
}

static void send_current(struct board *board, int16_t current)
{
    const struct wire_coil_current_t frame = {
        .coil_current_alive = board->current_alive,
        .measured_current = current,
        .sample_counter = board->counter,
    };
    uint8_t data[WIRE_COIL_CURRENT_LENGTH];

    (void)wire_coil_current_pack(data, &frame, sizeof(data));
    send_sealed(board, WIRE_COIL_CURRENT_FRAME_ID, false, data, sizeof(data));
    board->current_alive = (uint8_t)((board->current_alive + 1u) % WIRE_ALIVE_MODULUS);
}

void report_boot_up(struct board *board)
{
    send_heartbeat(board, BOOT_UP);
}

void report_sample(struct board *board, int64_t now_ns, const struct board_reading *reading)
{
    const int16_t current = measured_current(board, reading->current);

    send_encoder(board, reading, current);
    if (!board->config.fd && ((board->counter % WIRE_CURRENT_EVERY) == 0u)) {
        send_current(board, current);
    }
    if (now_ns >= board->next_heartbeat_ns) {
        board->next_heartbeat_ns = now_ns + WIRE_HEARTBEAT_NS;
        send_heartbeat(board, OPERATIONAL);
    }
}
