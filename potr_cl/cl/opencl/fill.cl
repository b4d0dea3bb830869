/* Fills a buffer with two 32-bit words in turn; a work-item does a word. Both kernel families use it.

   Macros: none.

   On GPUs: no macros. */

kernel void fill(global uint *words, ulong count, uint first, uint second)
{
    const size_t i = get_global_id(0);
    if (i < count)
        words[i] = i & 1 ? second : first;
}
