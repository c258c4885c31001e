/* What the test programs promise: CHECK ends a program whose condition does not hold, and says
 * where. What ends it is exit(1), unless CHECK_END is defined first: a fuzzer wants abort(). */
#ifndef CHECK_H
#define CHECK_H

#include <stdio.h>
#include <stdlib.h>

#ifndef CHECK_END
#define CHECK_END exit(1)
#endif

#define CHECK(condition)                                                    \
    do {                                                                    \
        if (!(condition)) {                                                 \
            fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #condition); \
            CHECK_END;                                                      \
        }                                                                   \
    } while (0)

#endif
