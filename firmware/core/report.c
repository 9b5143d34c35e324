#include "report.h"

uint32_t report_identifier(const struct board *board, uint32_t of_node_1)
{
    return of_node_1 + board->config.node - 1u;
}

static void send_heartbeat(struct board *board, bool boot_up)
{
    const struct wire_heartbeat *heartbeat = board->config.wire->heartbeat;
    uint8_t data[WIRE_LONGEST] = {0};

    if (heartbeat != NULL) {
        heartbeat->pack(data, boot_up);
        board->send(board->context, report_identifier(board, heartbeat->identifier), heartbeat->fd, data,
                    heartbeat->length);
    }
}

static void send_frame(struct board *board, const struct wire_frame *frame, struct board_turn *turn,
                       struct wire_report *report)
{
    const uint32_t identifier = report_identifier(board, frame->identifier);
    uint8_t data[WIRE_LONGEST] = {0};

    report->alive = turn->alive;
    frame->pack(data, report, turn->page);
    protection_seal(&frame->protection, identifier, turn->alive, data, frame->length);
    board->send(board->context, identifier, frame->fd, data, frame->length);
    turn->alive = (turn->alive >= frame->alive_most) ? 0u : (turn->alive + 1u);
    turn->page = ((turn->page + 1u) >= frame->pages) ? 0u : (turn->page + 1u);
    turn->samples = frame->every;
}

void report_boot_up(struct board *board)
{
    send_heartbeat(board, true);
}

void report_sample(struct board *board, int64_t now_ns, const struct board_reading *reading)
{
    const struct wire *wire = board->config.wire;
    struct wire_report report = {
        .counter = board->counter,
        .x = reading->x,
        .y = reading->y,
        .current = board->output.on ? reading->current : (board_real)0,
        .amplifier = board_reported_amplifier(board),
        .fault = board_reported_fault(board),
        .referenced = reading->referenced,
        .scaling = &board->config.scaling,
    };

    report.good = reading->valid && wire->fits(&report);
    for (uint8_t i = 0u; i < wire->frame_count; i++) {
        struct board_turn *turn = &board->turns[i];

        if (turn->samples == 0u) {
            send_frame(board, &wire->frames[i], turn, &report);
        }
        turn->samples--;
    }
    if ((wire->heartbeat != NULL) && (now_ns >= board->next_heartbeat_ns)) {
        board->next_heartbeat_ns = now_ns + wire->heartbeat->period_ns;
        send_heartbeat(board, false);
    }
}
