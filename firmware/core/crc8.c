#include "crc8.h"

#define POLYNOMIAL (0x1Du)
#define TOP_BIT (0x80u)

/* Bit by bit, 136 shifts for the longest frame: where that is too slow, a table of 256 bytes serves. */
static uint8_t crc8_of_byte(uint8_t crc, uint8_t byte)
{
    unsigned int value = (unsigned int)crc ^ byte;

    for (unsigned int bit = 0u; bit < 8u; bit++) {
        value = ((value & TOP_BIT) != 0u) ? ((value << 1) ^ POLYNOMIAL) : (value << 1);
        value &= 0xFFu;
    }
    return (uint8_t)value;
}

uint8_t crc8_of_frame(uint16_t data_id, const uint8_t *payload, size_t length)
{
    uint8_t crc = crc8_of_byte(0u, (uint8_t)(data_id & 0xFFu));

    crc = crc8_of_byte(crc, (uint8_t)(data_id >> 8));
    for (size_t i = 1u; i < length; i++) {
        crc = crc8_of_byte(crc, payload[i]);
    }
    return crc;
}
