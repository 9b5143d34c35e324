/* What the board says on the bus. */
#ifndef REPORT_H
#define REPORT_H

#include "board.h"

/* The identifier of this board's frame that has `of_node_1` at node 1. */
uint32_t report_identifier(const struct board *board, uint32_t of_node_1);

/* Say once that the board begins. */
void report_boot_up(struct board *board);

/* Send the frames whose turn it is with the sample that was just taken, and the heartbeat if it is due. */
void report_sample(struct board *board, int64_t now_ns, const struct board_reading *reading);

#endif
