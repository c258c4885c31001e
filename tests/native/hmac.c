/* Reads pairs of a key and a message from standard input, each behind its length, and writes their
 * tags. For tests/test_links.py. */
#include "br_hmac.h"
#include "br_transport.h"

int main(void) {
    static uint8_t secret[BR_DATAGRAM], data[BR_DATAGRAM], tag[BR_SHA256_BYTES];
    static const volatile sig_atomic_t stopping = 0;
    char why[64];
    br_link link;
    br_hmac key;
    if (br_link_open(&link, "stdio", &stopping, why, sizeof why)) return 1;
    for (long size; (size = link.by->receive(&link, secret, sizeof secret)) >= 0;) {
        br_hmac_set_key(&key, secret, (size_t)size);
        size = link.by->receive(&link, data, sizeof data);
        br_sha256 hash = key.inner;
        for (size_t at = 0; at < (size_t)size; at += 7) /* in parts */
            br_sha256_add(&hash, data + at, (size_t)size - at < 7 ? (size_t)size - at : 7);
        br_hmac_end(&key, &hash, tag);
        br_link_send(&link, tag, sizeof tag);
    }
    return link.unsent != 0;
}
