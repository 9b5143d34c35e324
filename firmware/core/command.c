#include "command.h"

#include "crc8.h"
#include "wire.h"

/* Fills in what a frame of either kind has; false if the pattern of a switch is neither yes nor no. */
static bool filled_in(struct command *command, uint8_t alive, uint8_t enable, uint8_t reset, int16_t current,
                      uint32_t echo)
{
    command->alive = alive;
    command->enable = enable == WIRE_COMMAND_ENABLE_ON_CHOICE;
    command->reset = reset == WIRE_COMMAND_RESET_FAULT_YES_CHOICE;
    command->current = current;
    command->echo = echo;
    return (alive != COMMAND_NO_ALIVE) && (command->enable || (enable == WIRE_COMMAND_ENABLE_OFF_CHOICE)) &&
           (command->reset || (reset == WIRE_COMMAND_RESET_FAULT_NO_CHOICE));
}

static bool unpacked_fd(struct command *command, const uint8_t *data, size_t length)
{
    struct wire_command_fd_t frame;

    return (wire_command_fd_unpack(&frame, data, length) == 0) &&
           filled_in(command, frame.command_alive, frame.enable, frame.reset_fault, frame.control_current,
                     frame.echoed_counter);
}

static bool unpacked_classic(struct command *command, const uint8_t *data, size_t length)
{
    struct wire_command_t frame;

    return (wire_command_unpack(&frame, data, length) == 0) &&
           filled_in(command, frame.command_alive, frame.enable, frame.reset_fault, frame.control_current,
                     frame.echoed_counter);
}

bool command_checked(struct command *command, bool fd, uint32_t identifier, const uint8_t *data, size_t length)
{
    const size_t right = fd ? (size_t)WIRE_COMMAND_FD_LENGTH : (size_t)WIRE_COMMAND_LENGTH;
    bool good = (length == right) && (data[0] == crc8_of_frame((uint16_t)identifier, data, length));

    if (good) {
        good = fd ? unpacked_fd(command, data, length) : unpacked_classic(command, data, length);
    }
    return good;
}
