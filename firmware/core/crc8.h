/* CRC of AUTOSAR E2E profile 1: CRC-8 with polynomial 0x1D, start and final XOR zero, over the data id and the payload. */
#ifndef CRC8_H
#define CRC8_H

#include <stddef.h>
#include <stdint.h>

/* CRC of a payload without its first byte, which is the CRC's own place. `data_id` is the CAN identifier; it is not
 * sent, so that a frame under a wrong identifier fails its check. */
uint8_t crc8_of_frame(uint16_t data_id, const uint8_t *payload, size_t length);

#endif
