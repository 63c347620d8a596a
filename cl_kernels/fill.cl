/* Fill memory with one 4-byte word: the fill commands of drivers are up to 20 times slower, and some checkers of memory
 * ignore them.
 *
 * One item = 16 words.  No local memory.  Deterministic. */
#include "common.h"

/* values[i] = word for i < count, rounded up to 16: buffers are whole 64-byte lines. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void fill_words(
    __global uint *restrict values,  // [count]
    const uint word,
    const uint count)
{
    const size_t i = get_global_id(0) * (size_t)16;
    if (i < count)
        vstore16((uint16)(word), 0, values + i);
}
