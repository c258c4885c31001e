/* Datagrams on a serial line: each with its CRC-32 (IEEE 802.3, u32, big-endian) behind it is
 * stuffed by COBS (Cheshire and Baker, 1999), so that it has no byte 0, and stands between two of
 * them. What is damaged is counted, and the next 0 begins a new frame.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

#include "br_transport.h"

#define CRC_BYTES 4
#define CONTENT (BR_DATAGRAM + BR_SEAL_BYTES + CRC_BYTES)
#define FRAME (CONTENT + CONTENT / 254 + 3) /* at most */
#define QUEUED 8192 /* bytes that may wait, telemetry included; inputs behind more are left out */
#define SHORT 1024  /* what is longer, as telemetry, is left out where it would have to wait */

struct br_line {
    uint8_t raw[4096], in[FRAME], out[FRAME];
    size_t at;     /* of the next byte in raw, of which link->unread are left */
    size_t length; /* of the frame that comes; FRAME + 1: too long */
    size_t begin;  /* of what is in out, of which link->queued are left */
};

static uint32_t crc32_of(const uint8_t *data, size_t size) {
    static const uint32_t of[16] = {0x00000000u, 0x1db71064u, 0x3b6e20c8u, 0x26d930acu,
                                    0x76dc4190u, 0x6b6b51f4u, 0x4db26158u, 0x5005713cu,
                                    0xedb88320u, 0xf00f9344u, 0xd6d6a3e8u, 0xcb61b38cu,
                                    0x9b64c2b0u, 0x86d3d2d4u, 0xa00ae278u, 0xbdbdf21cu};
    uint32_t crc = ~0u;
    for (size_t i = 0; i < size; ++i) {
        crc ^= data[i];
        crc = crc >> 4 ^ of[crc & 15];
        crc = crc >> 4 ^ of[crc & 15];
    }
    return ~crc;
}

/* Writes the frame of a datagram; its length. */
static size_t frame_of(const uint8_t *data, size_t size, uint8_t *out) {
    const uint32_t crc = crc32_of(data, size);
    size_t at = 0, head; /* where the length of the block at hand belongs */
    out[at++] = 0;       /* ends what may be left of noise */
    head = at++;
    for (size_t i = 0; i < size + CRC_BYTES; ++i) {
        const uint8_t byte = (uint8_t)(i < size ? data[i] : crc >> 8 * (size + 3 - i));
        if (byte) out[at++] = byte;
        if (byte && at - head < 255) continue;
        out[head] = (uint8_t)(at - head);
        head = at++;
    }
    out[head] = (uint8_t)(at - head);
    out[at++] = 0;
    return at;
}

/* What is between two zeros, unstuffed in place; its length, or -1. */
static long unstuff(uint8_t *frame, size_t size) {
    size_t made = 0;
    for (size_t at = 0; at < size;) {
        const size_t code = frame[at], block = code - 1;
        if (code > size - at) return -1;
        memmove(frame + made, frame + at + 1, block);
        made += block, at += code;
        if (code < 255 && at < size) frame[made++] = 0;
    }
    return (long)made;
}

/* Length of the datagram that takes the place of a frame, or -1. */
static long open_frame(uint8_t *frame, size_t size) {
    const long length = size <= FRAME ? unstuff(frame, size) - CRC_BYTES : -1;
    if (length < 0) return -1;
    const uint8_t *sum = frame + length;
    const uint32_t said =
        (uint32_t)sum[0] << 24 | (uint32_t)sum[1] << 16 | (uint32_t)sum[2] << 8 | sum[3];
    return said == crc32_of(frame, (size_t)length) ? length : -1;
}

/* --- the line --- */

static speed_t speed_of(const char *digits) {
    static const struct {
        const char *digits;
        speed_t speed;
    } known[] = {{"115200", B115200},   {"230400", B230400},   {"460800", B460800},
                 {"921600", B921600},   {"1000000", B1000000}, {"2000000", B2000000},
                 {"3000000", B3000000}, {"4000000", B4000000}};
    for (size_t i = 0; i < sizeof known / sizeof known[0]; ++i)
        if (!strcmp(known[i].digits, digits)) return known[i].speed;
    return B0;
}

static int open_serial(br_link *link, const char *where, char *text, size_t size) {
    const char *colon = strrchr(where, ':'); /* names of devices may have some */
    const int given = colon && colon[1] && !colon[1 + strspn(colon + 1, "0123456789")];
    struct termios raw = {.c_cflag = CS8 | CREAD | CLOCAL};
    char device[256];
    const int length = given ? (int)(colon - where) : (int)strlen(where);
    const speed_t speed = speed_of(given ? colon + 1 : "921600");
    if (speed == B0)
        return br_refused(text, size, where,
                          "no rate of these: 115200, 230400, 460800, 921600, 1000000, 2000000, "
                          "3000000, 4000000");
    raw.c_cc[VMIN] = 1;
    cfsetispeed(&raw, speed);
    cfsetospeed(&raw, speed);
    if (snprintf(device, sizeof device, "%.*s", length, where) >= (int)sizeof device)
        return br_refused(text, size, where, "the name is too long");
    link->in = link->out = open(device, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (link->in < 0 || tcsetattr(link->in, TCSANOW, &raw) || tcgetattr(link->in, &raw))
        return br_refused(text, size, device, strerror(errno));
    if (cfgetispeed(&raw) != speed || cfgetospeed(&raw) != speed)
        return br_refused(text, size, where, "the line cannot have this rate; give another one");
    link->line = calloc(1, sizeof *link->line);
    return link->line ? 0 : br_refused(text, size, device, strerror(errno));
}

/* What the system takes now of what is queued. */
static void flush(br_link *link) {
    struct br_line *line = link->line;
    while (link->queued) {
        const ssize_t put = write(link->out, line->out + line->begin, link->queued);
        if (put < 0 && errno != EAGAIN && errno != EINTR) link->broken = 1;
        if (put <= 0) return;
        line->begin += (size_t)put;
        link->queued -= (size_t)put;
    }
}

static int send_frame(br_link *link, const uint8_t *data, size_t size) {
    struct br_line *line = link->line;
    flush(link);
    const size_t behind = link->queued, longest = size + CRC_BYTES + 3 + (size + CRC_BYTES) / 254;
    if (link->broken || (behind && (size > SHORT || behind + longest > QUEUED)) || longest > FRAME)
        return -1;
    memmove(line->out, line->out + line->begin, behind);
    line->begin = 0;
    link->queued += frame_of(data, size, line->out + behind);
    flush(link);
    return link->broken ? -1 : 0;
}

/* The datagram of the next whole frame among the bytes that have come; or none. */
static long next_frame(br_link *link, uint8_t *data, size_t size) {
    struct br_line *line = link->line;
    while (link->unread) {
        const uint8_t byte = line->raw[line->at++];
        link->unread -= 1;
        if (byte) {
            if (line->length < FRAME) line->in[line->length] = byte;
            line->length += line->length <= FRAME;
            continue;
        }
        const size_t length = line->length;
        line->length = 0;
        if (!length) continue;
        const long got = open_frame(line->in, length);
        if (got >= 0 && (size_t)got <= size) {
            memcpy(data, line->in, (size_t)got);
            return got;
        }
        link->bad_frames += 1;
    }
    return BR_LINK_NOTHING;
}

/* Reads once at most. */
static long receive_frame(br_link *link, uint8_t *data, size_t size) {
    struct br_line *line = link->line;
    flush(link);
    const long found = next_frame(link, data, size);
    if (found != BR_LINK_NOTHING) return found;
    const ssize_t got = read(link->in, line->raw, sizeof line->raw);
    if (got < 0 && (errno == EAGAIN || errno == EINTR)) return BR_LINK_NOTHING;
    if (got <= 0) return BR_LINK_ENDED; /* unplugged */
    line->at = 0;
    link->unread = (size_t)got;
    return next_frame(link, data, size);
}

static int descriptor(const br_link *link) { return link->in; }

static void close_line(br_link *link) {
    close(link->in);
    free(link->line);
}

const br_transport br_serial = {"serial",   open_serial, receive_frame,
                                send_frame, descriptor,  close_line};
