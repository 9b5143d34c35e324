#include "command.h"

void command_sets_start(struct command_sets *sets, uint8_t parts, uint32_t modulus, int64_t period_ns)
{
    sets->parts = parts;
    sets->modulus = modulus;
    sets->longest_ns = (period_ns * ((modulus > 0u) ? (int64_t)modulus : 1)) / 2;
    sets->used = 0u;
}

static struct command_set *counted(struct command_sets *sets, uint32_t count, int64_t at_ns)
{
    struct command_set *found = NULL;

    for (uint8_t i = 0u; i < sets->used; i++) {
        struct command_set *known = &sets->sets[i];

        /* The newest of them is the last. */
        if ((known->count == count) && ((at_ns - known->begin_ns) <= sets->longest_ns)) {
            found = known;
        }
    }
    return found;
}

static struct command_set *recent(struct command_sets *sets, uint8_t bit, int64_t at_ns)
{
    struct command_set *found = NULL;

    if (sets->used > 0u) {
        struct command_set *newest = &sets->sets[sets->used - 1u];

        if (!newest->closed && ((newest->parts & bit) == 0u) && ((at_ns - newest->begin_ns) < sets->longest_ns)) {
            found = newest;
        }
    }
    return found;
}

static struct command_set *begun(struct command_sets *sets, uint32_t count, int64_t at_ns)
{
    const struct command_set fresh = {.count = count, .begin_ns = at_ns, .first = UINT8_MAX};

    if (sets->used == COMMAND_SETS) {
        for (uint8_t i = 1u; i < COMMAND_SETS; i++) {
            sets->sets[i - 1u] = sets->sets[i];
        }
        sets->used--;
    }
    sets->sets[sets->used] = fresh;
    sets->used++;
    return &sets->sets[sets->used - 1u];
}

/* Add what a frame says to what the others of its command said. */
static void join(struct command_set *set, uint8_t part, const struct command *said)
{
    struct command *whole = &set->command;

    if (((said->given & COMMAND_ALIVE) != 0u) && (part < set->first)) {
        set->first = part;
        whole->alive = said->alive;
    }
    if ((said->given & COMMAND_ENABLE) != 0u) {
        whole->enable = said->enable;
    }
    if ((said->given & COMMAND_RESET) != 0u) {
        whole->reset = said->reset;
    }
    if ((said->given & COMMAND_CURRENT) != 0u) {
        whole->current = said->current;
    }
    if ((said->given & COMMAND_ECHO) != 0u) {
        whole->echo = said->echo;
    }
    whole->given |= said->given;
}

enum command_part command_sets_add(struct command_sets *sets, uint8_t part, struct command *command, int64_t at_ns)
{
    const uint8_t bit = (uint8_t)(1u << part);
    const uint32_t count = (sets->modulus > 0u) ? (command->alive % sets->modulus) : 0u;
    struct command_set *own = (sets->modulus > 0u) ? counted(sets, count, at_ns) : recent(sets, bit, at_ns);
    enum command_part result = COMMAND_WAITS;

    if (own == NULL) {
        own = begun(sets, count, at_ns);
    }
    if ((own->parts & bit) != 0u) {
        result = COMMAND_REPEATED;
    } else {
        own->parts |= bit;
        join(own, part, command);
        if (!own->closed && (own->parts == ((1u << sets->parts) - 1u))) {
            /* What is older and not whole by now is given up. */
            for (struct command_set *set = sets->sets; set <= own; set++) {
                set->closed = true;
            }
            *command = own->command;
            result = COMMAND_WHOLE;
        }
    }
    return result;
}
