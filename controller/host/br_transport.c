/* See br_transport.h. */
#define _GNU_SOURCE /* ppoll */
#include <errno.h>
#include <netdb.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "br_transport.h"

#define NS_PER_S 1000000000
#define WAITING_BYTES (1 << 20) /* of datagrams that wait: the newest of a stall are wanted */

int64_t br_now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

int br_refused(char *text, size_t size, const char *what, const char *why) {
    snprintf(text, size, "%s: %s", what, why);
    return -1;
}

/* --- datagrams --- */

static int bound(br_link *link, int domain, const struct sockaddr *at, socklen_t length) {
    const int waiting = WAITING_BYTES; /* or as many as the system grants */
    link->in = link->out = socket(domain, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (link->in < 0) return -1;
    setsockopt(link->in, SOL_SOCKET, SO_RCVBUF, &waiting, sizeof waiting);
    return bind(link->in, at, length);
}

/* The address before the last colon, without the brackets of IPv6; -1: it is too long. */
static int host_of(const char *where, const char *colon, char *host, size_t size) {
    size_t length = (size_t)(colon - where);
    if (length > 1 && where[0] == '[' && colon[-1] == ']') where += 1, length -= 2;
    if (length >= size) return -1;
    memcpy(host, where, length);
    host[length] = 0;
    return 0;
}

static int open_udp(br_link *link, const char *where, char *text, size_t size) {
    const char *colon = strrchr(where, ':');
    char host[256];
    if (!colon || host_of(where, colon, host, sizeof host))
        return br_refused(text, size, where, "no address and port, such as 127.0.0.1:7450");
    const struct addrinfo wanted = {.ai_socktype = SOCK_DGRAM,
                                    .ai_flags = AI_NUMERICHOST | AI_NUMERICSERV};
    struct addrinfo *found;
    const int failed = getaddrinfo(host, colon + 1, &wanted, &found);
    if (failed) return br_refused(text, size, where, gai_strerror(failed));
    const int unbound = bound(link, found->ai_family, found->ai_addr, found->ai_addrlen);
    freeaddrinfo(found);
    return unbound ? br_refused(text, size, where, strerror(errno)) : 0;
}

/* Removes a socket file that a killed process has left, to which no process listens any more. */
static void remove_left_over(const struct sockaddr_un *at) {
    struct stat there;
    if (lstat(at->sun_path, &there) || !S_ISSOCK(there.st_mode)) return;
    const int probe = socket(AF_UNIX, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    const int alone = probe >= 0 && connect(probe, (const struct sockaddr *)at, sizeof *at) &&
                      errno == ECONNREFUSED;
    if (probe >= 0) close(probe);
    if (alone) unlink(at->sun_path);
}

static int open_unix(br_link *link, const char *where, char *text, size_t size) {
    struct sockaddr_un *at = &link->own;
    struct stat made;
    if (!*where || strlen(where) >= sizeof at->sun_path)
        return br_refused(text, size, where, "no path of at most 107 bytes");
    at->sun_family = AF_UNIX;
    strcpy(at->sun_path, where);
    remove_left_over(at);
    if (bound(link, AF_UNIX, (const struct sockaddr *)at, sizeof *at) || lstat(where, &made))
        return br_refused(text, size, where, strerror(errno));
    link->device = made.st_dev;
    link->inode = made.st_ino;
    return 0;
}

static long receive_datagram(br_link *link, uint8_t *data, size_t size) {
    br_address *from = &link->from;
    from->size = sizeof from->at;
    memset(&from->at, 0, sizeof from->at); /* for comparisons */
    const ssize_t got =
        recvfrom(link->in, data, size, 0, (struct sockaddr *)&from->at, &from->size);
    return got >= 0 ? (long)got : BR_LINK_NOTHING;
}

static int send_datagram(br_link *link, const uint8_t *data, size_t size) {
    const br_address *peer = &link->peer;
    if (!peer->size) return -1;
    const struct sockaddr *at = (const struct sockaddr *)&peer->at;
    return sendto(link->out, data, size, 0, at, peer->size) == (ssize_t)size ? 0 : -1;
}

static int descriptor(const br_link *link) { return link->in; }

static void close_datagrams(br_link *link) {
    struct stat there;
    close(link->in);
    if (link->own.sun_family == AF_UNIX && !lstat(link->own.sun_path, &there) &&
        there.st_dev == link->device && there.st_ino == link->inode)
        unlink(link->own.sun_path);
}

/* --- standard input and output --- */

static int open_stdio(br_link *link, const char *where, char *text, size_t size) {
    if (*where) return br_refused(text, size, "stdio", "nothing comes behind it");
    link->in = STDIN_FILENO, link->out = STDOUT_FILENO;
    return 0;
}

/* Both until all of it is done; -1: the stream has ended, or the program is to. */
static int read_all(br_link *link, uint8_t *data, size_t size) {
    for (size_t done = 0; done < size;) {
        const ssize_t got = read(link->in, data + done, size - done);
        if (got < 0 && errno == EINTR && !*link->stopping) continue;
        if (got <= 0) return -1;
        done += (size_t)got;
    }
    return 0;
}

static int write_all(br_link *link, const uint8_t *data, size_t size) {
    for (size_t done = 0; done < size;) {
        const ssize_t put = write(link->out, data + done, size - done);
        if (put < 0 && errno == EINTR && !*link->stopping) continue;
        if (put <= 0) return -1;
        done += (size_t)put;
    }
    return 0;
}

static long receive_stream(br_link *link, uint8_t *data, size_t size) {
    uint8_t head[4];
    if (read_all(link, head, sizeof head)) return BR_LINK_ENDED;
    const size_t length =
        (size_t)head[0] << 24 | (size_t)head[1] << 16 | (size_t)head[2] << 8 | head[3];
    if (length > size || read_all(link, data, length)) return BR_LINK_ENDED;
    return (long)length;
}

/* Part of a datagram may have gone: after a failure nothing more is sent. */
static int send_stream(br_link *link, const uint8_t *data, size_t size) {
    const uint8_t head[4] = {(uint8_t)(size >> 24), (uint8_t)(size >> 16), (uint8_t)(size >> 8),
                             (uint8_t)size};
    link->broken |=
        link->broken || write_all(link, head, sizeof head) || write_all(link, data, size);
    return link->broken ? -1 : 0;
}

static void close_stream(br_link *link) { (void)link; }

/* --- any --- */

static const br_transport udp = {"udp",         open_udp,   receive_datagram,
                                 send_datagram, descriptor, close_datagrams};
static const br_transport local = {"unix",        open_unix,  receive_datagram,
                                   send_datagram, descriptor, close_datagrams};
static const br_transport stdio = {"stdio",     open_stdio, receive_stream,
                                   send_stream, descriptor, close_stream};
static const br_transport *const transports[] = {&udp, &local, &stdio, &br_serial};

int br_link_open(br_link *link, const char *name, const volatile sig_atomic_t *stopping, char *text,
                 size_t size) {
    const size_t length = strcspn(name, ":");
    for (size_t i = 0; i < sizeof transports / sizeof transports[0]; ++i) {
        const br_transport *one = transports[i];
        if (strlen(one->name) != length || strncmp(one->name, name, length)) continue;
        *link = (br_link){.by = one, .stopping = stopping};
        return one->open(link, name + length + (name[length] == ':'), text, size);
    }
    return br_refused(text, size, name,
                      "no link; use udp:ADDRESS:PORT, unix:PATH, serial:DEVICE or stdio");
}

/* A descriptor may be readable and have nothing, as after a datagram with a bad checksum. */
long br_link_receive(br_link *link, int64_t until_ns, uint8_t *data, size_t size) {
    struct pollfd one = {.fd = link->by->descriptor(link)};
    for (;;) {
        int64_t left_ns = until_ns - br_now_ns();
        if (left_ns < 0) left_ns = 0;
        const struct timespec left = {.tv_sec = (time_t)(left_ns / NS_PER_S),
                                      .tv_nsec = (long)(left_ns % NS_PER_S)};
        if (link->broken) return BR_LINK_ENDED;
        one.events = link->queued ? POLLIN | POLLOUT : POLLIN;
        if (link->unread || ppoll(&one, 1, &left, NULL) > 0) {
            const long got = link->by->receive(link, data, size);
            if (got >= 0 && link->seal) {
                const long length = br_seal_open(link->seal, data, (size_t)got);
                return length >= 0 ? length : BR_LINK_REFUSED;
            }
            if (got != BR_LINK_NOTHING) return got;
        }
        if (!left_ns || *link->stopping) return BR_LINK_NOTHING;
    }
}

void br_link_send(br_link *link, uint8_t *data, size_t size) {
    if (link->seal) size = br_seal_put(link->seal, data, size);
    link->unsent += link->by->send(link, data, size) != 0;
}

int br_same_address(const br_address *one, const br_address *other) {
    return one->size == other->size && !memcmp(&one->at, &other->at, one->size);
}

void br_link_close(br_link *link) { link->by->close(link); }
