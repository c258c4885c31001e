/* Loads racing line and weights from one folder after another:
 *
 *   host_files IDENTITY FOLDER...
 *
 * One line for each: 0, or -1 and why. Code 1: refused without a reason, or taken without use. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "br_files.h"

int main(int argc, char **argv) {
    const size_t size = br_mpc_memory_size();
    char *block = aligned_alloc(64, (size + 63) / 64 * 64);
    if (!block || argc < 3) return 2;
    for (int i = 2; i < argc; ++i) {
        char text[128];
        memset(text, 0x55, sizeof text);
        br_mpc *mpc;
        if (br_mpc_init(block, size, &mpc)) return 2;
        const int failed = br_files_load(mpc, argv[i], argv[1], NULL, text, sizeof text);
        if (failed && (!memchr(text, 0, sizeof text) || strlen(text) < 20)) return 1;
        printf("%d %s\n", failed, failed ? text : "");
    }
    free(block);
    return 0;
}
