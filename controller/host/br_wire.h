/* Messages as MessagePack maps, by the tables of br_messages.h, which 'bayesrace build' generates
 * from the message types (bayesrace/messages/types.py): what one program writes the other reads.
 *
 * A message is read whole or not at all: every field once, of its type and within its limits, and
 * no other. Nothing is read beyond the data, whatever they are, and nothing is allocated.
 */
#ifndef BR_WIRE_H
#define BR_WIRE_H

#include <stddef.h>
#include <stdint.h>

typedef enum {
    BR_WHOLE,   /* int64_t */
    BR_REAL,    /* double */
    BR_FLAG,    /* int, 0 or 1 */
    BR_TEXT,    /* char[4 * most + 1], of UTF-8: at most so many characters, none of them 0 */
    BR_BYTES,   /* uint8_t[most] */
    BR_WHOLES,  /* int64_t[most] */
    BR_REALS,   /* double[most] */
    BR_RECORDS, /* most structures of their own table */
    BR_MEASURES /* br_measures: a map from some of the states' names to value and deviation */
} br_wire_kind;

typedef struct br_wire_table br_wire_table;

typedef struct {
    const char *name;
    br_wire_kind kind;
    size_t at;       /* in the structure */
    size_t count_at; /* of how many there are, an int; BR_FIXED: always most */
    int least, most;
    double low, high;
    const br_wire_table *of;  /* of BR_RECORDS */
    const char *const *words; /* of BR_TEXT, where it is one of these; the last is NULL */
} br_wire_field;

#define BR_FIXED ((size_t)-1)

struct br_wire_table {
    const char *topic;
    int schema; /* first field of the map; 0: a part of a message, without */
    int count;
    const br_wire_field *fields;
    size_t size; /* of the structure */
};

#define BR_QUANTITIES 7

typedef struct {
    int count;
    int of[BR_QUANTITIES]; /* number of the state */
    double value[BR_QUANTITIES], deviation[BR_QUANTITIES];
} br_measures;

/* A datagram is an array of two: the topic's name and the message. */

/* The topic of a datagram, NULL if it is none; *payload: where its message begins. */
const char *br_wire_topic(const uint8_t *data, size_t size, size_t *payload, char topic[32]);

/* 0, or -1 if the data are not such a message; the structure then holds anything. */
int br_wire_read(const br_wire_table *table, const uint8_t *data, size_t size, void *message);

/* Characters of a text; -1: it is not UTF-8. */
int br_wire_characters(const char *text, size_t bytes);

/* The datagram's length; 0: it does not fit, or the message breaks its limits. */
size_t br_wire_write(const br_wire_table *table, const void *message, uint8_t *data, size_t size);

#endif
