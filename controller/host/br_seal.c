/* See br_seal.h. */
#include "br_seal.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#define COUNTER 8
#define TAG 16
#define SHORTEST 32
#define LONGEST 4096

#define TO_PROGRAM '>'
#define FROM_PROGRAM '<'

_Static_assert(COUNTER + TAG == BR_SEAL_BYTES, "a seal is a counter and a tag");

static int64_t realtime_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static int64_t larger(int64_t a, int64_t b) { return a > b ? a : b; }

/* Why a file is no key; NULL: it is one. */
static const char *fault_of(int file, uint8_t *secret, long *length) {
    struct stat there;
    if (file < 0 || fstat(file, &there)) return strerror(errno);
    /* as bayesrace.files.check_private: a service may read by its group what root owns */
    const mode_t others = there.st_uid || !geteuid() ? 077 : 027;
    if (there.st_mode & others) return "others can read this key; chmod 600 it";
    *length = read(file, secret, LONGEST + 1);
    if (*length < 0) return strerror(errno);
    return *length < SHORTEST || *length > LONGEST ? "a key has 32 to 4096 bytes" : NULL;
}

int br_seal_read(br_seal *seal, const char *path, char *text, size_t size) {
    uint8_t secret[LONGEST + 1];
    long length = 0;
    const int file = open(path, O_RDONLY | O_CLOEXEC);
    const char *fault = fault_of(file, secret, &length);
    if (file >= 0) close(file);
    if (fault) {
        snprintf(text, size, "%s: %s", path, fault);
        return -1;
    }
    *seal = (br_seal){.accepted = realtime_ns()};
    br_hmac_set_key(&seal->key, secret, (size_t)length);
    return 0;
}

static void tag_of(const br_seal *seal, char way, const uint8_t *data, size_t size, uint8_t *tag) {
    br_sha256 hash = seal->key.inner;
    br_sha256_add(&hash, &way, 1);
    br_sha256_add(&hash, data, size);
    br_hmac_end(&seal->key, &hash, tag);
}

size_t br_seal_put(br_seal *seal, uint8_t *data, size_t size) {
    uint8_t tag[BR_SHA256_BYTES];
    seal->sent = larger(realtime_ns(), larger(seal->sent, seal->accepted) + 1);
    for (int i = 0; i < COUNTER; ++i)
        data[size++] = (uint8_t)((uint64_t)seal->sent >> (56 - 8 * i));
    tag_of(seal, FROM_PROGRAM, data, size, tag);
    memcpy(data + size, tag, TAG);
    return size + TAG;
}

/* In constant time. */
static int genuine(const br_seal *seal, const uint8_t *data, size_t size) {
    uint8_t tag[BR_SHA256_BYTES], different = 0;
    tag_of(seal, TO_PROGRAM, data, size, tag);
    for (size_t i = 0; i < TAG; ++i) different |= tag[i] ^ data[size + i];
    return !different;
}

long br_seal_open(br_seal *seal, const uint8_t *data, size_t size) {
    uint64_t counter = 0;
    const size_t length = size - BR_SEAL_BYTES;
    if (size < BR_SEAL_BYTES || !genuine(seal, data, length + COUNTER)) {
        seal->forged += 1;
        return -1;
    }
    for (size_t i = 0; i < COUNTER; ++i) counter = counter << 8 | data[length + i];
    if (counter <= (uint64_t)seal->accepted || counter >= INT64_MAX / 2) {
        seal->replayed += 1;
        return -1;
    }
    seal->accepted = (int64_t)counter;
    return (long)length;
}
