/* Reads datagrams from standard input, each behind its length, and writes what it has read again;
 * of one that it refuses an empty datagram. For tests/test_host_wire.py. */
#include <string.h>

#include "br_messages.h"
#include "br_transport.h"

static union {
    br_state_message state;
    br_command_message command;
    br_actuation_message actuation;
    br_braking_message braking;
    br_telemetry_message telemetry;
    br_update_message update;
    br_updated_message updated;
} message;

static size_t again(const uint8_t *data, size_t size, uint8_t *out) {
    static const br_wire_table *const tables[] = {
        &BR_STATE_TABLE,     &BR_COMMAND_TABLE, &BR_ACTUATION_TABLE, &BR_BRAKING_TABLE,
        &BR_TELEMETRY_TABLE, &BR_UPDATE_TABLE,  &BR_UPDATED_TABLE};
    char topic[32];
    size_t payload;
    if (!br_wire_topic(data, size, &payload, topic)) return 0;
    for (int i = 0; i < 7; ++i)
        if (!strcmp(tables[i]->topic, topic) &&
            !br_wire_read(tables[i], data + payload, size - payload, &message))
            return br_wire_write(tables[i], &message, out, BR_DATAGRAM);
    return 0;
}

int main(void) {
    static uint8_t data[BR_DATAGRAM], out[BR_DATAGRAM + BR_SEAL_BYTES];
    static const volatile sig_atomic_t stopping = 0;
    char why[64];
    br_link link;
    if (br_link_open(&link, "stdio", &stopping, why, sizeof why)) return 1;
    for (long size; (size = link.by->receive(&link, data, sizeof data)) >= 0;)
        br_link_send(&link, out, again(data, (size_t)size, out));
    return link.unsent != 0;
}
