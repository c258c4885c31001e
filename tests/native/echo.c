/* Sends each datagram back: echo LINK [KEY]. For tests/test_links.py. */
#include <stdio.h>

#include "br_transport.h"

static volatile sig_atomic_t stopping;
static uint8_t data[BR_DATAGRAM + BR_SEAL_BYTES];

static void stop(int number) { stopping = number; }

int main(int argc, char **argv) {
    br_seal seal = {.forged = 0};
    br_link link;
    char why[256];
    signal(SIGTERM, stop);
    if ((argc > 2 && br_seal_read(&seal, argv[2], why, sizeof why)) ||
        br_link_open(&link, argv[1], &stopping, why, sizeof why)) {
        fprintf(stderr, "%s\n", why);
        return 1;
    }
    if (argc > 2) link.seal = &seal;
    fprintf(stderr, "ready\n");
    for (long size = 0; !stopping && size != BR_LINK_ENDED;) {
        size = br_link_receive(&link, br_now_ns() + 50000000, data, BR_DATAGRAM);
        link.peer = link.from;
        if (size >= 0) br_link_send(&link, data, (size_t)size);
    }
    br_link_close(&link);
    fprintf(stderr, "bad %lld, forged %lld, replayed %lld, unsent %lld\n",
            (long long)link.bad_frames, (long long)seal.forged, (long long)seal.replayed,
            (long long)link.unsent);
    return 0;
}
