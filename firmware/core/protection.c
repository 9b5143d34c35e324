#include "protection.h"

#define POLYNOMIAL_1D (0x1Du)
#define POLYNOMIAL_2F (0x2Fu)
#define POLYNOMIAL_1021 (0x1021u)
#define ALIVE_MASK (0x0Fu)

/* Bit by bit, 136 shifts for a frame of 16 bytes: where that is too slow, a table serves. */
static uint32_t crc_of_byte(uint32_t crc, uint8_t byte, uint32_t polynomial, uint32_t width)
{
    const uint32_t mask = (1u << width) - 1u;
    uint32_t value = crc ^ ((uint32_t)byte << (width - 8u));

    for (uint32_t bit = 0u; bit < 8u; bit++) {
        const bool top = ((value >> (width - 1u)) & 1u) != 0u;

        value = (value << 1) & mask;
        if (top) {
            value ^= polynomial;
        }
    }
    return value;
}

static uint32_t crc_of_frame(const struct protection *protection, uint32_t identifier, uint32_t alive,
                             const uint8_t *data, size_t length)
{
    const bool wide = protection->profile == PROTECTION_E2E_5;
    const bool has_id = (protection->profile == PROTECTION_E2E_1) || wide;
    const uint32_t width = wide ? 16u : 8u;
    const size_t own = wide ? 2u : 1u;
    const uint32_t id = protection->by_identifier ? identifier : protection->data_id;
    const uint8_t id_bytes[2] = {(uint8_t)(id & 0xFFu), (uint8_t)((id >> 8) & 0xFFu)};
    uint32_t polynomial = POLYNOMIAL_1D;
    uint32_t start = 0xFFu;
    uint32_t end = 0xFFu;
    uint32_t crc;

    if (protection->profile == PROTECTION_E2E_1) {
        start = 0u;
        end = 0u;
    } else if (protection->profile == PROTECTION_E2E_2) {
        polynomial = POLYNOMIAL_2F;
    } else if (wide) {
        polynomial = POLYNOMIAL_1021;
        start = 0xFFFFu;
        end = 0u;
    } else {
        /* SAE J1850. */
    }
    crc = start;
    if (has_id && !wide) {
        crc = crc_of_byte(crc_of_byte(crc, id_bytes[0], polynomial, width), id_bytes[1], polynomial, width);
    }
    for (size_t i = 0u; i < length; i++) {
        if ((i < protection->place) || (i >= (protection->place + own))) {
            crc = crc_of_byte(crc, data[i], polynomial, width);
        }
    }
    if (wide) {
        crc = crc_of_byte(crc_of_byte(crc, id_bytes[0], polynomial, width), id_bytes[1], polynomial, width);
    } else if (protection->profile == PROTECTION_E2E_2) {
        crc = crc_of_byte(crc, protection->data_ids[alive & ALIVE_MASK], polynomial, width);
    } else {
        /* The data id came first, or there is none. */
    }
    return crc ^ end;
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
            data[place] = (uint8_t)((protection->big_endian ? (crc >> 8) : crc) & 0xFFu);
            data[place + 1u] = (uint8_t)((protection->big_endian ? crc : (crc >> 8)) & 0xFFu);
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
