/* Turns rows of `width` floats, one row a splat, into columns of `stride` floats. The first row is that of splat
   `first`. Both kernel families use it.

   Macros: none.

   On GPUs: no macros. */

kernel void columns(global const float *rows, uint first, uint width, uint stride, global float *result)
{
    const size_t row = get_global_id(0);
    for (uint column = 0; column < width; ++column)
        result[column * (size_t)stride + first + row] = rows[row * width + column];
}
