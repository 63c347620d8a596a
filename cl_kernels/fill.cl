/* Fill memory with one 4-byte word: the fill commands of drivers are up to 20 times slower, and some memory checkers
 * ignore them.
 *
 * One item = 16 words.  No local memory.  Deterministic. */
#include "common.h"

/* values[i] = word for i < 16 * lines: buffers are whole 64-byte lines, and counts of words may exceed 32 bits. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void fill_words(
    __global uint *restrict values,  // [16*lines]
    const uint word,
    const uint lines)
{
    const size_t line = get_global_id(0);
    if (line < lines)
        vstore16((uint16)(word), line, values);
}
