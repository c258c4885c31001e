/* harness.c in a thread whose stack is filled before: prints how many bytes of it were used. */
#include <pthread.h>

int harness(int argc, char **argv);

#define main harness
#include "harness.c"
#undef main

#define SIZE (1 << 20)
#define FILL 0xA5

static _Alignas(4096) unsigned char stack[SIZE];
static char **words;

static void *run(void *none) {
    (void)none;
    CHECK(harness(3, words) == 0);
    return NULL;
}

int main(int argc, char **argv) {
    pthread_t thread;
    pthread_attr_t attributes;
    CHECK(argc == 3);
    words = argv;
    memset(stack, FILL, sizeof stack);
    CHECK(!pthread_attr_init(&attributes) && !pthread_attr_setstack(&attributes, stack, SIZE));
    CHECK(!pthread_create(&thread, &attributes, run, NULL) && !pthread_join(thread, NULL));
    int untouched = 0;
    while (untouched < SIZE && stack[untouched] == FILL) ++untouched;
    printf("%d\n", SIZE - untouched);
    return 0;
}
