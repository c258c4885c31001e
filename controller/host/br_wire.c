/* See br_wire.h. Bytes are put together one by one, so that the host's byte order does not matter.
 */
#include <math.h>
#include <string.h>

#include "br_messages.h"

/* --- items of MessagePack, one after the other --- */

typedef enum { IS_WHOLE, IS_REAL, IS_FLAG, IS_TEXT, IS_BYTES, IS_ARRAY, IS_MAP } item_kind;

typedef struct {
    item_kind kind;
    int64_t whole; /* also of a flag */
    double real;
    size_t count;     /* bytes, items or pairs that follow */
    const char *text; /* or bytes; not terminated */
} item;

typedef struct {
    const uint8_t *at, *end;
} reader;

static int read_unsigned(reader *r, int bytes, uint64_t *value) {
    if (r->end - r->at < bytes) return -1;
    *value = 0;
    for (int i = 0; i < bytes; ++i) *value = *value << 8 | *r->at++;
    return 0;
}

static int read_real(reader *r, int bytes, item *found) {
    uint64_t bits;
    if (read_unsigned(r, bytes, &bits)) return -1;
    if (bytes == 8) {
        memcpy(&found->real, &bits, sizeof found->real);
    } else {
        const uint32_t half = (uint32_t)bits;
        float real;
        memcpy(&real, &half, sizeof real);
        found->real = real;
    }
    found->kind = IS_REAL;
    return 0;
}

/* Negative ones are extended; those beyond int64_t are none. */
static int read_whole(reader *r, int bytes, int is_signed, item *found) {
    uint64_t bits;
    if (read_unsigned(r, bytes, &bits)) return -1;
    if (!is_signed && bits > INT64_MAX) return -1;
    if (is_signed && bytes < 8 && bits >> (8 * bytes - 1)) bits |= ~(uint64_t)0 << (8 * bytes);
    memcpy(&found->whole, &bits, sizeof bits);
    found->kind = IS_WHOLE;
    return 0;
}

static int counted(item *found, item_kind kind, size_t count) {
    found->kind = kind;
    found->count = count;
    return 0;
}

static int read_count(reader *r, int bytes, item_kind kind, item *found) {
    uint64_t count;
    return read_unsigned(r, bytes, &count) ? -1 : counted(found, kind, (size_t)count);
}

static int read_head(reader *r, item *found) {
    if (r->at == r->end) return -1;
    const uint8_t head = *r->at++;
    if (head < 0x80 || head >= 0xe0) {
        found->kind = IS_WHOLE;
        found->whole = (int8_t)head;
        return 0;
    }
    if (head < 0x90) return counted(found, IS_MAP, head & 0x0fu);
    if (head < 0xa0) return counted(found, IS_ARRAY, head & 0x0fu);
    if (head < 0xc0) return counted(found, IS_TEXT, head & 0x1fu);
    switch (head) {
    case 0xc2:
    case 0xc3:
        found->kind = IS_FLAG;
        found->whole = head & 1;
        return 0;
    case 0xc4:
    case 0xc5:
    case 0xc6:
        return read_count(r, 1 << (head - 0xc4), IS_BYTES, found);
    case 0xca:
    case 0xcb:
        return read_real(r, head == 0xcb ? 8 : 4, found);
    case 0xcc:
    case 0xcd:
    case 0xce:
    case 0xcf:
        return read_whole(r, 1 << (head - 0xcc), 0, found);
    case 0xd0:
    case 0xd1:
    case 0xd2:
    case 0xd3:
        return read_whole(r, 1 << (head - 0xd0), 1, found);
    case 0xd9:
    case 0xda:
    case 0xdb:
        return read_count(r, 1 << (head - 0xd9), IS_TEXT, found);
    case 0xdc:
    case 0xdd:
        return read_count(r, 2 << (head - 0xdc), IS_ARRAY, found);
    case 0xde:
    case 0xdf:
        return read_count(r, 2 << (head - 0xde), IS_MAP, found);
    default: /* nil, extensions: no message has any */
        return -1;
    }
}

static int read_item(reader *r, item_kind kind, item *found) {
    if (read_head(r, found) || found->kind != kind) return -1;
    if (kind != IS_TEXT && kind != IS_BYTES) return 0;
    if ((size_t)(r->end - r->at) < found->count) return -1;
    found->text = (const char *)r->at;
    r->at += found->count;
    return 0;
}

static int is_text(const item *found, const char *text) {
    return found->count == strlen(text) && !memcmp(found->text, text, found->count);
}

/* --- fields --- */

static int in_range(const br_wire_field *field, double value) { /* NaN is in none */
    return value >= field->low && value <= field->high;
}

static int take_real(reader *r, const br_wire_field *field, double *value) {
    item found;
    if (read_head(r, &found)) return -1;
    if (found.kind != IS_REAL && found.kind != IS_WHOLE) return -1;
    *value = found.kind == IS_REAL ? found.real : (double)found.whole;
    return in_range(field, *value) ? 0 : -1;
}

static int take_whole(reader *r, const br_wire_field *field, int64_t *value) {
    item found;
    if (read_item(r, IS_WHOLE, &found) || !in_range(field, (double)found.whole)) return -1;
    *value = found.whole;
    return 0;
}

static int take_flag(reader *r, int *value) {
    item found;
    if (read_item(r, IS_FLAG, &found)) return -1;
    *value = (int)found.whole;
    return 0;
}

/* No longer forms than needed, no surrogates. */
int br_wire_characters(const char *text, size_t bytes) {
    static const uint32_t least[] = {0, 0x80, 0x800, 0x10000};
    int count = 0;
    for (size_t i = 0; i < bytes; ++count) {
        const uint8_t head = (uint8_t)text[i++];
        if (head < 0x80) continue;
        const unsigned more = head < 0xe0 ? 1 : head < 0xf0 ? 2 : 3;
        if (head < 0xc2 || head > 0xf4 || bytes - i < more) return -1;
        uint32_t code = head & (0x3fu >> more);
        for (unsigned k = 0; k < more; ++k, ++i) {
            const uint8_t next = (uint8_t)text[i];
            if ((next & 0xc0) != 0x80) return -1;
            code = code << 6 | (next & 0x3fu);
        }
        if (code < least[more] || code > 0x10ffff || (code >= 0xd800 && code < 0xe000)) return -1;
    }
    return count;
}

static int fits(const br_wire_field *field, const char *text, size_t bytes) {
    const int count = bytes <= 4 * (size_t)field->most ? br_wire_characters(text, bytes) : -1;
    if (count < field->least || count > field->most) return 0;
    for (const char *const *word = field->words; word; ++word) {
        if (!*word) return 0;
        if (strlen(*word) == bytes && !memcmp(*word, text, bytes)) return 1;
    }
    return 1;
}

static int take_text(reader *r, const br_wire_field *field, char *text) {
    item found;
    if (read_item(r, IS_TEXT, &found) || !fits(field, found.text, found.count)) return -1;
    if (memchr(found.text, 0, found.count)) return -1;
    memcpy(text, found.text, found.count);
    text[found.count] = 0;
    return 0;
}

static int take_bytes(reader *r, const br_wire_field *field, char *message) {
    item found;
    if (read_item(r, IS_BYTES, &found) || found.count > (size_t)field->most) return -1;
    memcpy(message + field->at, found.text, found.count);
    *(int *)(message + field->count_at) = (int)found.count;
    return 0;
}

static const br_wire_field deviation = {.low = BR_DEVIATION_LOW, .high = BR_DEVIATION_HIGH};

static const char *const quantities[BR_QUANTITIES] = {BR_QUANTITY_NAMES};

static int quantity(const item *name) {
    for (int i = 0; i < BR_QUANTITIES; ++i)
        if (is_text(name, quantities[i])) return i;
    return -1;
}

static int take_measures(reader *r, const br_wire_field *field, br_measures *measures) {
    item map, name, pair;
    int known = 0;
    if (read_item(r, IS_MAP, &map) || !map.count || map.count > BR_QUANTITIES) return -1;
    measures->count = (int)map.count;
    for (int i = 0; i < measures->count; ++i) {
        if (read_item(r, IS_TEXT, &name)) return -1;
        const int of = measures->of[i] = quantity(&name);
        if (of < 0 || known >> of & 1) return -1;
        known |= 1 << of;
        if (read_item(r, IS_ARRAY, &pair) || pair.count != 2) return -1;
        if (take_real(r, field, &measures->value[i])) return -1;
        if (take_real(r, &deviation, &measures->deviation[i])) return -1;
    }
    return 0;
}

static int read_map(reader *r, const br_wire_table *table, void *message);

static int take_array(reader *r, const br_wire_field *field, char *message) {
    item array;
    if (read_item(r, IS_ARRAY, &array)) return -1;
    if (array.count < (size_t)field->least || array.count > (size_t)field->most) return -1;
    char *at = message + field->at;
    for (size_t i = 0; i < array.count; ++i) {
        int failed;
        if (field->kind == BR_REALS)
            failed = take_real(r, field, (double *)at + i);
        else if (field->kind == BR_WHOLES)
            failed = take_whole(r, field, (int64_t *)at + i);
        else
            failed = read_map(r, field->of, at + i * field->of->size);
        if (failed) return -1;
    }
    if (field->count_at != BR_FIXED) *(int *)(message + field->count_at) = (int)array.count;
    return 0;
}

static int take_field(reader *r, const br_wire_field *field, char *message) {
    char *at = message + field->at;
    switch (field->kind) {
    case BR_WHOLE:
        return take_whole(r, field, (int64_t *)at);
    case BR_REAL:
        return take_real(r, field, (double *)at);
    case BR_FLAG:
        return take_flag(r, (int *)at);
    case BR_TEXT:
        return take_text(r, field, at);
    case BR_BYTES:
        return take_bytes(r, field, message);
    case BR_MEASURES:
        return take_measures(r, field, (br_measures *)at);
    default:
        return take_array(r, field, message);
    }
}

/* The number of the field of a name, from the one that is next; -1: there is none. */
static int field_of(const br_wire_table *table, const item *name, int next) {
    for (int i = 0; i < table->count; ++i) {
        const int at = (next + i) % table->count;
        if (is_text(name, table->fields[at].name)) return at;
    }
    return -1;
}

static int read_schema(reader *r, const br_wire_table *table) {
    static const br_wire_field any = {.low = 0, .high = 1e6};
    int64_t schema;
    return take_whole(r, &any, &schema) || schema != table->schema ? -1 : 0;
}

/* As deep as the tables are nested: two levels. */
static int read_map(reader *r, const br_wire_table *table, void *message) {
    item map, name;
    uint64_t known = 0;
    int next = 0, versions = 0;
    if (read_item(r, IS_MAP, &map)) return -1;
    if (map.count != (size_t)(table->count + (table->schema > 0))) return -1;
    for (size_t i = 0; i < map.count; ++i) {
        if (read_item(r, IS_TEXT, &name)) return -1;
        if (table->schema && is_text(&name, "schema")) {
            if (versions++ || read_schema(r, table)) return -1;
            continue;
        }
        const int at = field_of(table, &name, next);
        if (at < 0 || known >> at & 1) return -1;
        known |= (uint64_t)1 << at;
        next = at + 1;
        if (take_field(r, &table->fields[at], message)) return -1;
    }
    return versions == (table->schema > 0) ? 0 : -1;
}

const char *br_wire_topic(const uint8_t *data, size_t size, size_t *payload, char topic[32]) {
    reader r = {data, data + size};
    item pair, name;
    if (read_item(&r, IS_ARRAY, &pair) || pair.count != 2) return NULL;
    if (read_item(&r, IS_TEXT, &name) || name.count > 31) return NULL;
    memcpy(topic, name.text, name.count);
    topic[name.count] = 0;
    *payload = (size_t)(r.at - data);
    return topic;
}

int br_wire_read(const br_wire_table *table, const uint8_t *data, size_t size, void *message) {
    reader r = {data, data + size};
    return read_map(&r, table, message) || r.at != r.end ? -1 : 0;
}

/* --- writing --- */

typedef struct {
    uint8_t *at, *end;
    int failed; /* something did not fit, or is beyond its limits */
} writer;

static void put(writer *w, uint8_t head, uint64_t value, int bytes) {
    if (w->end - w->at <= bytes) w->failed = 1;
    if (w->failed) return;
    *w->at++ = head;
    for (int i = bytes - 1; i >= 0; --i) *w->at++ = (uint8_t)(value >> (8 * i));
}

static void put_count(writer *w, uint8_t few, unsigned most_few, uint8_t head, size_t count) {
    if (count <= most_few)
        put(w, (uint8_t)(few | count), 0, 0);
    else
        put(w, head, count, 2);
}

static void put_bytes(writer *w, const void *bytes, size_t length) {
    if (w->failed || (size_t)(w->end - w->at) < length) {
        w->failed = 1;
        return;
    }
    memcpy(w->at, bytes, length);
    w->at += length;
}

static void put_text(writer *w, const char *text) {
    const size_t length = strlen(text);
    put_count(w, 0xa0, 31, 0xda, length);
    put_bytes(w, text, length);
}

static void put_real(writer *w, const br_wire_field *field, double value) {
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    w->failed |= !in_range(field, value);
    put(w, 0xcb, bits, 8);
}

static void put_whole(writer *w, const br_wire_field *field, int64_t value) {
    w->failed |= !in_range(field, (double)value);
    if (value >= 0 && value < 128)
        put(w, (uint8_t)value, 0, 0);
    else
        put(w, 0xd3, (uint64_t)value, 8);
}

static void put_map(writer *w, const br_wire_table *table, const void *message);

static void put_array(writer *w, const br_wire_field *field, const char *message) {
    const char *at = message + field->at;
    const int fixed = field->count_at == BR_FIXED;
    const int count = fixed ? field->most : *(const int *)(message + field->count_at);
    w->failed |= count < field->least || count > field->most;
    put_count(w, 0x90, 15, 0xdc, (size_t)count);
    for (int i = 0; i < count && !w->failed; ++i) {
        if (field->kind == BR_REALS)
            put_real(w, field, ((const double *)at)[i]);
        else if (field->kind == BR_WHOLES)
            put_whole(w, field, ((const int64_t *)at)[i]);
        else
            put_map(w, field->of, at + (size_t)i * field->of->size);
    }
}

static void put_measures(writer *w, const br_wire_field *field, const br_measures *measures) {
    put_count(w, 0x80, 15, 0xde, (size_t)measures->count);
    for (int i = 0; i < measures->count; ++i) {
        put_text(w, quantities[measures->of[i]]);
        put(w, 0x92, 0, 0);
        put_real(w, field, measures->value[i]);
        put_real(w, &deviation, measures->deviation[i]);
    }
}

static void put_field(writer *w, const br_wire_field *field, const char *message) {
    const char *at = message + field->at;
    switch (field->kind) {
    case BR_WHOLE:
        put_whole(w, field, *(const int64_t *)at);
        break;
    case BR_REAL:
        put_real(w, field, *(const double *)at);
        break;
    case BR_FLAG:
        put(w, *(const int *)at ? 0xc3 : 0xc2, 0, 0);
        break;
    case BR_TEXT:
        w->failed |= !fits(field, at, strlen(at));
        put_text(w, at);
        break;
    case BR_BYTES: {
        const int count = *(const int *)(message + field->count_at);
        w->failed |= count < 0 || count > field->most;
        put(w, 0xc5, (uint64_t)count, 2);
        put_bytes(w, at, w->failed ? 0 : (size_t)count);
        break;
    }
    case BR_MEASURES:
        put_measures(w, field, (const br_measures *)at);
        break;
    default:
        put_array(w, field, message);
        break;
    }
}

static void put_map(writer *w, const br_wire_table *table, const void *message) {
    put_count(w, 0x80, 15, 0xde, (size_t)(table->count + (table->schema > 0)));
    if (table->schema) {
        put_text(w, "schema");
        put(w, (uint8_t)table->schema, 0, 0);
    }
    for (int i = 0; i < table->count && !w->failed; ++i) {
        put_text(w, table->fields[i].name);
        put_field(w, &table->fields[i], message);
    }
}

size_t br_wire_write(const br_wire_table *table, const void *message, uint8_t *data, size_t size) {
    writer w = {data, data + size, 0};
    put(&w, 0x92, 0, 0);
    put_text(&w, table->topic);
    put_map(&w, table, message);
    return w.failed ? 0 : (size_t)(w.at - data);
}
