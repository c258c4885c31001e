/* How messages come and go: a table of five functions for each kind of link.
 *
 *   udp:ADDRESS:PORT   datagrams to that port; answers go to whom the car is driven for
 *   unix:PATH          the same on a Unix socket, between processes of one machine
 *   stdio              standard input and output, each datagram behind its length (u32, big-endian)
 *
 * None blocks but in receive, where a timeout says for how long, and stdio, which is for files and
 * pipes: there receive waits for the whole datagram.
 */
#ifndef BR_TRANSPORT_H
#define BR_TRANSPORT_H

#include <stddef.h>
#include <stdint.h>
#include <sys/socket.h>
#include <sys/un.h>

#define BR_DATAGRAM 65536 /* longer ones are cut off, and no message then */

typedef struct br_transport br_transport;

typedef struct {
    const br_transport *by;
    int in, out;
    struct sockaddr_storage from, peer; /* of the newest datagram; of whom the answers are for */
    socklen_t from_size, peer_size;
    char path[sizeof(((struct sockaddr_un *)0)->sun_path)]; /* to be removed; empty: none */
    int64_t unsent;                                         /* datagrams that could not be sent */
} br_link;

struct br_transport {
    const char *name;
    /* Opens what is behind the colon. 0, or -1 and a sentence in text. */
    int (*open)(br_link *link, const char *where, char *text, size_t size);
    /* Length of the next datagram; 0: there is none, -1: there will be none any more. */
    long (*receive)(br_link *link, uint8_t *data, size_t size);
    /* To the peer. 0, or -1 if it could not be sent. */
    int (*send)(br_link *link, const uint8_t *data, size_t size);
    /* Readable when a datagram has come, for poll. */
    int (*descriptor)(const br_link *link);
    void (*close)(br_link *link);
};

/* A link by its name as above. 0, or -1 and a sentence in text. */
int br_link_open(br_link *link, const char *name, char *text, size_t size);

/* The next datagram, waited for until the monotonic clock says until_ns (0: only looked for). As
 * receive. */
long br_link_receive(br_link *link, int64_t until_ns, uint8_t *data, size_t size);

void br_link_send(br_link *link, const uint8_t *data, size_t size);

/* Answers go to whom the newest datagram came from. */
void br_link_follow(br_link *link);

void br_link_close(br_link *link);

int64_t br_now_ns(void);

#endif
