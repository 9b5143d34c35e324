/* The CRCs of AUTOSAR E2E profiles 1, 2 and 5 and of SAE J1850. They run over the payload but for their own bytes. */
#ifndef PROTECTION_H
#define PROTECTION_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum protection_profile { PROTECTION_NONE, PROTECTION_E2E_1, PROTECTION_E2E_2, PROTECTION_E2E_5, PROTECTION_J1850 };

struct protection {
    enum protection_profile profile;
    uint8_t place;            /* of the CRC's first byte in the payload */
    bool big_endian;          /* the CRC's byte order */
    bool by_identifier;       /* the data id is the CAN identifier, so that a frame under a wrong one fails its check */
    uint16_t data_id;         /* else; of profiles 1 and 5 */
    const uint8_t *data_ids;  /* 16 of them, of profile 2: the frame's count chooses one */
};

/* Write the CRC into its place. `alive` is the frame's own count. */
void protection_seal(const struct protection *protection, uint32_t identifier, uint32_t alive, uint8_t *data,
                     size_t length);

/* Whether the CRC is right; of a frame that has none it is. */
bool protection_right(const struct protection *protection, uint32_t identifier, uint32_t alive, const uint8_t *data,
                      size_t length);

#endif
