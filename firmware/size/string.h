/* What the frames and the compiler need of a C library: `make size` links none. */
#ifndef STRING_H
#define STRING_H

#include <stddef.h>

void *memset(void *target, int value, size_t size);
void *memcpy(void *target, const void *source, size_t size);

#endif
