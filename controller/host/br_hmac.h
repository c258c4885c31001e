/* HMAC-SHA-256 (RFC 2104, FIPS 180-4). */
#ifndef BR_HMAC_H
#define BR_HMAC_H

#include <stddef.h>
#include <stdint.h>

#define BR_SHA256_BYTES 32
#define BR_SHA256_BLOCK 64

typedef struct {
    uint32_t state[8];
    uint64_t size; /* bytes so far */
    uint8_t block[BR_SHA256_BLOCK];
} br_sha256;

/* Both hashes of a key, behind its block. */
typedef struct {
    br_sha256 inner, outer;
} br_hmac;

void br_sha256_start(br_sha256 *hash);
void br_sha256_add(br_sha256 *hash, const void *data, size_t size);
void br_sha256_end(br_sha256 *hash, uint8_t digest[BR_SHA256_BYTES]);

void br_hmac_set_key(br_hmac *key, const uint8_t *secret, size_t size);

/* The tag of what was added to a copy of key->inner. */
void br_hmac_end(const br_hmac *key, br_sha256 *inner, uint8_t tag[BR_SHA256_BYTES]);

#endif
