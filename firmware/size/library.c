/* The two functions of string.h. */
#include <string.h>

#include <stdint.h>

void *memset(void *target, int value, size_t size)
{
    uint8_t *bytes = target;

    for (size_t i = 0u; i < size; i++) {
        bytes[i] = (uint8_t)value;
    }
    return target;
}

void *memcpy(void *target, const void *source, size_t size)
{
    uint8_t *bytes = target;
    const uint8_t *others = source;

    for (size_t i = 0u; i < size; i++) {
        bytes[i] = others[i];
    }
    return target;
}
