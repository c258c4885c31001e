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

int64_t br_now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

static int refused(char *text, size_t size, const char *what, const char *why) {
    snprintf(text, size, "%s: %s", what, why);
    return -1;
}

/* --- datagrams --- */

static int bound(br_link *link, int domain, const struct sockaddr *at, socklen_t length) {
    link->in = link->out = socket(domain, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    return link->in < 0 ? -1 : bind(link->in, at, length);
}

static int open_udp(br_link *link, const char *where, char *text, size_t size) {
    const char *colon = strrchr(where, ':');
    char host[256];
    if (!colon || (size_t)(colon - where) >= sizeof host)
        return refused(text, size, where, "no address and port, such as 127.0.0.1:7450");
    memcpy(host, where, (size_t)(colon - where));
    host[colon - where] = 0;
    const struct addrinfo wanted = {.ai_socktype = SOCK_DGRAM,
                                    .ai_flags = AI_NUMERICHOST | AI_NUMERICSERV | AI_PASSIVE};
    struct addrinfo *found;
    const int failed = getaddrinfo(host, colon + 1, &wanted, &found);
    if (failed) return refused(text, size, where, gai_strerror(failed));
    const int unbound = bound(link, found->ai_family, found->ai_addr, found->ai_addrlen);
    freeaddrinfo(found);
    return unbound ? refused(text, size, where, strerror(errno)) : 0;
}

/* A socket that a killed process has left is removed, no other file. */
static int open_unix(br_link *link, const char *where, char *text, size_t size) {
    struct sockaddr_un at = {.sun_family = AF_UNIX};
    struct stat there;
    if (!*where || strlen(where) >= sizeof at.sun_path)
        return refused(text, size, where, "no path of at most 107 bytes");
    strcpy(at.sun_path, where);
    if (!stat(where, &there) && S_ISSOCK(there.st_mode)) unlink(where);
    if (bound(link, AF_UNIX, (const struct sockaddr *)&at, sizeof at))
        return refused(text, size, where, strerror(errno));
    strcpy(link->path, where);
    return 0;
}

static long receive_datagram(br_link *link, uint8_t *data, size_t size) {
    link->from_size = sizeof link->from;
    const ssize_t got =
        recvfrom(link->in, data, size, 0, (struct sockaddr *)&link->from, &link->from_size);
    return got > 0 ? (long)got : 0; /* an error is that of a datagram that was sent before */
}

static int send_datagram(br_link *link, const uint8_t *data, size_t size) {
    if (!link->peer_size) return -1;
    const struct sockaddr *peer = (const struct sockaddr *)&link->peer;
    return sendto(link->out, data, size, 0, peer, link->peer_size) == (ssize_t)size ? 0 : -1;
}

static int descriptor(const br_link *link) { return link->in; }

static void close_datagrams(br_link *link) {
    close(link->in);
    if (*link->path) unlink(link->path);
}

/* --- standard input and output --- */

static int open_stdio(br_link *link, const char *where, char *text, size_t size) {
    if (*where) return refused(text, size, "stdio", "nothing comes behind it");
    link->in = STDIN_FILENO, link->out = STDOUT_FILENO;
    return 0;
}

static int read_all(int from, uint8_t *data, size_t size) {
    for (size_t done = 0; done < size;) {
        const ssize_t got = read(from, data + done, size - done);
        if (got < 0 && errno == EINTR) continue;
        if (got <= 0) return -1;
        done += (size_t)got;
    }
    return 0;
}

static int write_all(int to, const uint8_t *data, size_t size) {
    for (size_t done = 0; done < size;) {
        const ssize_t put = write(to, data + done, size - done);
        if (put < 0 && errno == EINTR) continue;
        if (put <= 0) return -1;
        done += (size_t)put;
    }
    return 0;
}

static long receive_stream(br_link *link, uint8_t *data, size_t size) {
    uint8_t head[4];
    if (read_all(link->in, head, sizeof head)) return -1;
    const size_t length =
        (size_t)head[0] << 24 | (size_t)head[1] << 16 | (size_t)head[2] << 8 | head[3];
    if (length > size || read_all(link->in, data, length)) return -1;
    return (long)length;
}

static int send_stream(br_link *link, const uint8_t *data, size_t size) {
    const uint8_t head[4] = {(uint8_t)(size >> 24), (uint8_t)(size >> 16), (uint8_t)(size >> 8),
                             (uint8_t)size};
    return write_all(link->out, head, sizeof head) || write_all(link->out, data, size) ? -1 : 0;
}

static void close_stream(br_link *link) { (void)link; }

/* --- any --- */

static const br_transport transports[] = {
    {"udp", open_udp, receive_datagram, send_datagram, descriptor, close_datagrams},
    {"unix", open_unix, receive_datagram, send_datagram, descriptor, close_datagrams},
    {"stdio", open_stdio, receive_stream, send_stream, descriptor, close_stream}};

int br_link_open(br_link *link, const char *name, char *text, size_t size) {
    const size_t length = strcspn(name, ":");
    for (size_t i = 0; i < sizeof transports / sizeof transports[0]; ++i) {
        const br_transport *one = &transports[i];
        if (strlen(one->name) != length || strncmp(one->name, name, length)) continue;
        *link = (br_link){.by = one};
        return one->open(link, name + length + (name[length] == ':'), text, size);
    }
    return refused(text, size, name, "no link; use udp:ADDRESS:PORT, unix:PATH or stdio");
}

long br_link_receive(br_link *link, int64_t until_ns, uint8_t *data, size_t size) {
    struct pollfd one = {.fd = link->by->descriptor(link), .events = POLLIN};
    int64_t left_ns = until_ns - br_now_ns();
    if (left_ns < 0) left_ns = 0;
    const struct timespec left = {.tv_sec = (time_t)(left_ns / NS_PER_S),
                                  .tv_nsec = (long)(left_ns % NS_PER_S)};
    return ppoll(&one, 1, &left, NULL) > 0 ? link->by->receive(link, data, size) : 0;
}

void br_link_send(br_link *link, const uint8_t *data, size_t size) {
    link->unsent += link->by->send(link, data, size) != 0;
}

void br_link_follow(br_link *link) {
    link->peer = link->from;
    link->peer_size = link->from_size;
}

void br_link_close(br_link *link) { link->by->close(link); }
