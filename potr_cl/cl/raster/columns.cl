/* Rows of `width` floats, splat by splat, into columns of `stride`, from splat `first` on. */
kernel void columns(global const float *rows, uint first, uint width, uint stride_, global float *result)
{
    const size_t row = get_global_id(0), stride = stride_;
    for (uint column = 0; column < width; ++column)
        result[column * stride + first + row] = rows[row * width + column];
}
