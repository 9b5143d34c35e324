/* The least program that has a whole board in it: what `make size` measures. It is never run. */
#include "board.h"

#include <string.h>

/* Of the port, which is not measured: the Makefile gives them addresses. */
extern const struct board_config machine;
extern volatile int64_t timer_ns;
extern volatile uint32_t received_identifier;
extern volatile size_t received_length;

static struct board board;
static uint8_t received[WIRE_LONGEST];

static void send(void *context, uint32_t identifier, bool fd, const uint8_t *data, size_t length)
{
    (void)context;
    (void)fd;
    received_identifier = identifier;
    received_length = length;
    (void)memcpy(received, data, length);
}

static void drive(void *context, int64_t at_ns, bool on, int32_t code)
{
    (void)context;
    (void)on;
    timer_ns = at_ns + code;
}

int main(void)
{
    struct board_config config = machine;
    struct board_reading reading = {0};

    config.wire = SIZED_WIRE;
    (void)board_start(&board, &config, send, drive, NULL, timer_ns);
    for (;;) {
        reading.x = (int32_t)timer_ns;
        board_sample(&board, timer_ns, &reading);
        (void)board_receive(&board, received_identifier, received, received_length, timer_ns);
        board_act(&board, timer_ns);
        timer_ns = board_next_ns(&board);
        board_trip(&board, BOARD_FAULT_SUPPLY);
    }
}
