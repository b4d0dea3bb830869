/* Picks some splats' values out of columns: result[c][i] = columns[c][numbers[i]]. get_global_id(1) is the column. Both
   kernel families use it.

   Macros: none.

   On GPUs: no macros. */

kernel void gather_columns(
    global const float *columns,
    uint stride,
    global const uint *numbers,
    uint count,
    uint result_stride,
    global float *result)
{
    const size_t i = get_global_id(0);
    const size_t column = get_global_id(1);
    if (i < count)
        result[column * result_stride + i] = columns[column * stride + numbers[i]];
}
