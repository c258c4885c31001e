/* How messages come and go: a table of five functions for each kind of link.
 *
 *   udp:ADDRESS:PORT   datagrams to that port; answers go to whom the car is driven for
 *   unix:PATH          the same on a Unix socket, between processes of one machine
 *   serial:DEVICE[:BAUD]   frames on a serial line (br_serial.c), at 921600 baud by default
 *   stdio              standard input and output, each datagram behind its length (u32, big-endian)
 *
 * With a seal, each datagram is one under a key (br_seal.h).
 *
 * None waits but in br_link_receive, which says for how long, and stdio, which is for files and
 * pipes: what has begun to come or go there is waited for.
 */
#ifndef BR_TRANSPORT_H
#define BR_TRANSPORT_H

#include <signal.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/socket.h>
#include <sys/types.h>
#include <sys/un.h>

#include "br_seal.h"

#define BR_DATAGRAM 65536 /* longer ones are cut off, and no message then */

/* What is received in place of a datagram's length; refused: by the seal, which counts it. */
enum { BR_LINK_NOTHING = -1, BR_LINK_ENDED = -2, BR_LINK_REFUSED = -3 };

typedef struct br_transport br_transport;

typedef struct {
    struct sockaddr_storage at;
    socklen_t size; /* 0: there is no address */
} br_address;

typedef struct {
    const br_transport *by;
    const volatile sig_atomic_t *stopping; /* set: nothing is waited for any more */
    int in, out;
    br_address from, peer;  /* of the newest datagram; of whom the answers are for */
    struct sockaddr_un own; /* of a Unix socket, whose file is removed at the end, ... */
    dev_t device;           /* ... if it is still this one */
    ino_t inode;
    br_seal *seal;         /* NULL: none */
    struct br_line *line;  /* of a serial line, with its ... */
    size_t unread, queued; /* ... bytes that have come, and that are to go */
    int64_t bad_frames;    /* of it: damaged or too long */
    int broken;            /* nothing can be sent any more */
    int64_t unsent;        /* datagrams that could not be sent */
} br_link;

struct br_transport {
    const char *name;
    /* Opens what is behind the colon. 0, or -1 and a sentence in text. */
    int (*open)(br_link *link, const char *where, char *text, size_t size);
    /* Length of the next datagram, which may be 0; or one of the above. */
    long (*receive)(br_link *link, uint8_t *data, size_t size);
    /* To the peer. 0, or -1 if it could not be sent. */
    int (*send)(br_link *link, const uint8_t *data, size_t size);
    /* Readable when a datagram has come, for poll. */
    int (*descriptor)(const br_link *link);
    void (*close)(br_link *link);
};

extern const br_transport br_serial;

/* A link by its name as above. 0, or -1 and a sentence in text. */
int br_link_open(br_link *link, const char *name, const volatile sig_atomic_t *stopping, char *text,
                 size_t size);

/* The next datagram, waited for until the monotonic clock says until_ns (0: only looked for). As
 * receive. */
long br_link_receive(br_link *link, int64_t until_ns, uint8_t *data, size_t size);

/* Behind the datagram there is room for BR_SEAL_BYTES. */
void br_link_send(br_link *link, uint8_t *data, size_t size);

/* Whether two datagrams came from one address; of a stream all do. */
int br_same_address(const br_address *one, const br_address *other);

void br_link_close(br_link *link);

int64_t br_now_ns(void);

/* "what: why" into text; -1. */
int br_refused(char *text, size_t size, const char *what, const char *why);

#endif
