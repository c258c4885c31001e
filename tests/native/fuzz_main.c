/* Drives the fuzz target without clang: mutation, guided by coverage where gcc gives it.
 *
 *   fuzz INPUTS [SEED [CRASH]]     so many inputs from the seed; CRASH: where to leave a failing
 * one fuzz --replay FILE             that input once
 *
 * Compile the code under test with -fsanitize-coverage=trace-pc, this file without. Inputs that
 * reach a new part of the code become parents of others. The same seed gives the same inputs.
 */
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define LONGEST 1024
#define POOL 1024
#define MAP (1 << 16)

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);
void __sanitizer_cov_trace_pc(void);
const char *__asan_default_options(void);
const char *__ubsan_default_options(void);

typedef struct {
    size_t size;
    uint8_t bytes[LONGEST];
} input;

static input pool[POOL], trial;
static uint8_t seen[MAP];
static long found, number;
static const char *crash_file;

void __sanitizer_cov_trace_pc(void) {
    static uintptr_t before;
    const uintptr_t here =
        (uintptr_t)__builtin_return_address(0) - (uintptr_t)&LLVMFuzzerTestOneInput;
    uint8_t *edge = &seen[(here ^ before) % MAP];
    found += !*edge;
    *edge = 1;
    before = here >> 1;
}

const char *__asan_default_options(void) { return "abort_on_error=1"; }
const char *__ubsan_default_options(void) { return "abort_on_error=1"; }

/* Where every finding ends: a broken promise or a sanitizer's. */
static void failed(int signal_number) {
    (void)signal_number;
    fprintf(stderr, "fuzz: input %ld failed\n", number);
    FILE *file = crash_file ? fopen(crash_file, "wb") : NULL;
    if (file) {
        fwrite(trial.bytes, 1, trial.size, file);
        fclose(file);
    }
    _Exit(1);
}

static uint64_t random_state;
static uint64_t random_number(void) { /* splitmix64 */
    uint64_t z = random_state += 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return z ^ z >> 31;
}
static size_t below(size_t n) { return n ? random_number() % n : 0; }

static void random_bytes(size_t from, size_t to) {
    for (size_t i = from; i < to; ++i) trial.bytes[i] = (uint8_t)random_number();
    if (to > trial.size) trial.size = to;
}

static void mutate(const input *other) {
    const size_t place = below(trial.size), length = below(trial.size - place);
    switch (below(6)) {
    case 0:
        trial.bytes[place] ^= (uint8_t)(1u << below(8));
        break;
    case 1:
        trial.bytes[place] = (uint8_t)random_number();
        break;
    case 2:
        random_bytes(place, place + length % 16);
        break;
    case 3:
        random_bytes(trial.size, trial.size + below(LONGEST - trial.size));
        break;
    case 4: /* leave out a piece */
        memmove(trial.bytes + place, trial.bytes + place + length, trial.size - place - length);
        trial.size -= length;
        break;
    default: /* go on as another input does */
        if (place < other->size) {
            memcpy(trial.bytes + place, other->bytes + place, other->size - place);
            trial.size = other->size;
        }
    }
}

static int replay(const char *path) {
    FILE *file = fopen(path, "rb");
    if (!file) return 2;
    trial.size = fread(trial.bytes, 1, LONGEST, file);
    fclose(file);
    return LLVMFuzzerTestOneInput(trial.bytes, trial.size);
}

int main(int argc, char **argv) {
    if (argc < 2) return 2;
    if (argc == 3 && !strcmp(argv[1], "--replay")) return replay(argv[2]);
    const long count = atol(argv[1]);
    random_state = argc > 2 ? strtoull(argv[2], NULL, 10) : 1;
    crash_file = argc > 3 ? argv[3] : NULL;
    signal(SIGABRT, failed);
    size_t kept = 0;
    const clock_t begin = clock();
    for (number = 0; number < count; ++number) {
        trial.size = 0;
        if (kept < 8 || below(16) == 0) {
            random_bytes(0, below(LONGEST));
        } else {
            trial = pool[below(kept)];
            for (size_t i = 1 + below(6); i > 0; --i) mutate(&pool[below(kept)]);
        }
        const long before = found;
        LLVMFuzzerTestOneInput(trial.bytes, trial.size);
        if (found == before && kept >= 8) continue;
        pool[kept < POOL ? kept++ : below(POOL)] = trial;
    }
    const double seconds = (double)(clock() - begin) / CLOCKS_PER_SEC;
    printf("%ld inputs in %.1f s, %zu kept, %ld edges\n", count, seconds, kept, found);
    return 0;
}
