/* Levels of a file to values, by tables that the host has made: so every device gives the bits that the host gives. A
   work-item does one splat. Both kernel families use it.

   Levels come as arrays of columns, each `splats` long. Values go to columns that are `stride` long, from column `first`
   of the parameter on.

   Macros:
       LEVEL   type of a level;
       MAPPED  1: signed levels were mapped to unsigned ones, as docs/format.md has it (0, -1, 1, -2, ...); 0: they are
               what they are. */

inline int level_at(global const LEVEL *levels, size_t place)
{
    const int level = levels[place];
#if MAPPED
    return (level >> 1) ^ -(level & 1);
#else
    return level;
#endif
}

/* The value of each level of `columns` columns. */
kernel void look_up(
    global const LEVEL *levels,
    uint splats,
    uint columns,
    global const float *table,
    uint first,
    uint stride,
    global float *values)
{
    const size_t splat = get_global_id(0);
    if (splat >= splats)
        return;
    for (uint column = 0; column < columns; ++column)
        values[(first + column) * (size_t)stride + splat] = table[level_at(levels, column * (size_t)splats + splat)];
}

/* R, G, B of one SH coefficient, from three columns with its levels in Y, Co, Cg. A sum s of these has its value at
   table[middle + s]. */
kernel void colours(
    global const LEVEL *levels,
    uint splats,
    global const float *table,
    int middle,
    uint first,
    uint stride,
    global float *sh)
{
    const size_t splat = get_global_id(0);
    if (splat >= splats)
        return;
    const size_t column = stride;
    const int y = level_at(levels, splat);
    const int co = level_at(levels, splats + splat);
    const int cg = level_at(levels, 2 * (size_t)splats + splat);
    const int rest = y - cg;
    sh += first * column + splat;
    sh[0] = table[middle + rest + co];
    sh[column] = table[middle + y + cg];
    sh[2 * column] = table[middle + rest - co];
}
