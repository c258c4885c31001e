/* Datagrams under a shared key, for any link: behind each come a counter (u64, big-endian) and a
 * tag, the first 16 bytes of HMAC-SHA-256 over a letter for the direction, datagram and counter.
 *
 * Counters are the sender's realtime clock in ns, raised above all that it has sent and accepted.
 * One counts here if it is above all accepted before, and above the clock at the start. Datagrams
 * to and from the program have different letters, so that none counts where it was sent.
 */
#ifndef BR_SEAL_H
#define BR_SEAL_H

#include "br_hmac.h"

#define BR_SEAL_BYTES 24 /* that a datagram is longer by */

typedef struct {
    br_hmac key;
    int64_t sent, accepted;   /* highest counters */
    int64_t forged, replayed; /* refused: by the tag, by the counter */
} br_seal;

/* Takes the key of a file, 32 to 4096 bytes that others cannot read. 0, or -1 and a sentence. */
int br_seal_read(br_seal *seal, const char *path, char *text, size_t size);

/* Appends to a datagram, behind which there is room; its new length. */
size_t br_seal_put(br_seal *seal, uint8_t *data, size_t size);

/* Length of what was sealed, or -1. */
long br_seal_open(br_seal *seal, const uint8_t *data, size_t size);

#endif
