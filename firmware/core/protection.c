#include "protection.h"

#define ALIVE_MASK (0x0Fu)

/* A CRC; of those of 8 bits the upper byte is not used. */
struct algorithm {
    uint32_t width;
    uint32_t mask;
    uint32_t polynomial;
    uint32_t start;
    uint32_t end;
};

static struct algorithm algorithm_of(enum protection_profile profile)
{
    const struct algorithm e2e_1 = {8u, 0xFFu, 0x1Du, 0u, 0u};
    const struct algorithm e2e_2 = {8u, 0xFFu, 0x2Fu, 0xFFu, 0xFFu};
    const struct algorithm e2e_5 = {16u, 0xFFFFu, 0x1021u, 0xFFFFu, 0u};
    struct algorithm chosen = {8u, 0xFFu, 0x1Du, 0xFFu, 0xFFu}; /* SAE J1850 */

    if (profile == PROTECTION_E2E_1) {
        chosen = e2e_1;
    } else if (profile == PROTECTION_E2E_2) {
        chosen = e2e_2;
    } else if (profile == PROTECTION_E2E_5) {
        chosen = e2e_5;
    } else {
        /* As it is. */
    }
    return chosen;
}

/* Bit by bit, 136 shifts for a frame of 16 bytes: where that is too slow, a table serves. */
static uint32_t crc_of_byte(const struct algorithm *algorithm, uint32_t crc, uint8_t byte)
{
    const uint32_t top = algorithm->width - 1u;
    uint32_t value = crc ^ ((uint32_t)byte << (algorithm->width - 8u));

    for (uint32_t bit = 0u; bit < 8u; bit++) {
        const bool carry = ((value >> top) & 1u) != 0u;

        value = (value << 1) & algorithm->mask;
        if (carry) {
            value ^= algorithm->polynomial;
        }
    }
    return value;
}

static uint32_t crc_of_data_id(const struct protection *protection, const struct algorithm *algorithm, uint32_t crc,
                               uint32_t identifier)
{
    const uint32_t id = protection->by_identifier ? identifier : protection->data_id;
    const uint32_t half = crc_of_byte(algorithm, crc, (uint8_t)(id & 0xFFu));

    return crc_of_byte(algorithm, half, (uint8_t)((id >> 8) & 0xFFu));
}

static uint32_t crc_of_frame(const struct protection *protection, uint32_t identifier, uint32_t alive,
                             const uint8_t *data, size_t length)
{
    const struct algorithm algorithm = algorithm_of(protection->profile);
    const size_t end = protection->place + (size_t)(algorithm.width / 8u);
    uint32_t crc = algorithm.start;

    if (protection->profile == PROTECTION_E2E_1) {
        crc = crc_of_data_id(protection, &algorithm, crc, identifier);
    }
    for (size_t i = 0u; i < length; i++) {
        if ((i < protection->place) || (i >= end)) {
            crc = crc_of_byte(&algorithm, crc, data[i]);
        }
    }
    if (protection->profile == PROTECTION_E2E_5) {
        crc = crc_of_data_id(protection, &algorithm, crc, identifier);
    }
    if (protection->profile == PROTECTION_E2E_2) {
        crc = crc_of_byte(&algorithm, crc, protection->data_ids[alive & ALIVE_MASK]);
    }
    return crc ^ algorithm.end;
}

void protection_seal(const struct protection *protection, uint32_t identifier, uint32_t alive, uint8_t *data,
                     size_t length)
{
    const size_t place = protection->place;

    if (protection->profile != PROTECTION_NONE) {
        const uint32_t crc = crc_of_frame(protection, identifier, alive, data, length);

        if (protection->profile != PROTECTION_E2E_5) {
            data[place] = (uint8_t)crc;
        } else {
            const uint8_t low = (uint8_t)(crc & 0xFFu);
            const uint8_t high = (uint8_t)((crc >> 8) & 0xFFu);

            data[place] = protection->big_endian ? high : low;
            data[place + 1u] = protection->big_endian ? low : high;
        }
    }
}

bool protection_right(const struct protection *protection, uint32_t identifier, uint32_t alive, const uint8_t *data,
                      size_t length)
{
    const size_t place = protection->place;
    bool right = true;

    if (protection->profile != PROTECTION_NONE) {
        uint32_t sent = data[place];

        if (protection->profile == PROTECTION_E2E_5) {
            const uint32_t next = data[place + 1u];

            sent = protection->big_endian ? ((sent << 8) | next) : ((next << 8) | sent);
        }
        right = sent == crc_of_frame(protection, identifier, alive, data, length);
    }
    return right;
}
