    /* The paper's second half of the removal kernel (section "Effect of a splat's removal"): the tile's list front to
       back once more, the final colour P_K known, P_k and T as running sums and products,

           PD_k = P_k - P_{k+1} / (1 - alpha) + alpha / (1 - alpha) P_K

       Stands in removal_cpu.cl for the sweep from back to front; see removal_formulas.py. From here on r, g, b are the
       final colour, dr, dg, db twice its difference to the target, and pr, pg, pb the colour before a splat. */
    vfloat dr[TILE * VECTORS], dg[TILE * VECTORS], db[TILE * VECTORS];
    vfloat pr[TILE * VECTORS], pg[TILE * VECTORS], pb[TILE * VECTORS];
    for (int row = 0; row < pixel_rows; ++row) {
        float differences[3][TILE];
        for (int v = 0; v < VECTORS; ++v) {
            const int i = row * VECTORS + v;
            const vfloat left = fabs(t[i]);
            r[i] = MAD(left, (vfloat)(red), r[i]);
            g[i] = MAD(left, (vfloat)(green), g[i]);
            b[i] = MAD(left, (vfloat)(blue), b[i]);
            VSTORE(r[i], v, differences[0]);
            VSTORE(g[i], v, differences[1]);
            VSTORE(b[i], v, differences[2]);
            t[i] = (vfloat)(1.0f);
            pr[i] = pg[i] = pb[i] = (vfloat)(0.0f);
        }
        const size_t pixel = 3 * ((size_t)(origin.y + row) * view.width + origin.x);
        for (int column = 0; column < pixel_columns; ++column)
            for (int channel = 0; channel < 3; ++channel) {
                if (first_time)
                    target[pixel + 3 * column + channel] = differences[channel][column];
                differences[channel][column] -= target[pixel + 3 * column + channel];
            }
        for (int v = 0; v < VECTORS; ++v) {
            const int i = row * VECTORS + v;
            dr[i] = 2.0f * VLOAD(v, differences[0]);
            dg[i] = 2.0f * VLOAD(v, differences[1]);
            db[i] = 2.0f * VLOAD(v, differences[2]);
        }
    }

    first_alive = 0;
    end_alive = pixel_rows;
    for (uint block_begin = begin; block_begin < swept; block_begin += BLOCK) {
        const uint block_end = min(block_begin + BLOCK, swept);
        fetch_block(&block, shapes, colours, entries, block_begin, block_end, origin);
        for (int k = 0; k < (int)(block_end - block_begin); ++k) {
            const int first_row = max(block.first_row[k], first_alive);
            const int end_row = min(block.end_row[k], end_alive);
            const vint number = (vint)((int)(block_begin - begin) + k);
            const float x = block.x[k], a = block.a[k];
            const float red_k = block.red[k], green_k = block.green[k], blue_k = block.blue[k];
            vfloat au[VECTORS];
            for (int v = 0; v < VECTORS; ++v)
                au[v] = a * ((LANE_NUMBERS + (origin.x + v * LANES + 0.5f)) - x);
            vfloat effect = (vfloat)(0.0f), importance = (vfloat)(0.0f);
            for (int row = first_row; row < end_row; ++row) {
                const float dy = origin.y + row + 0.5f - block.y[k];
                const float bu = block.b[k] * dy;
                const float cv = block.c[k] * dy;
                const float level = MAD(-cv, cv, block.log2_opacity[k]);
                for (int v = 0; v < VECTORS; ++v) {
                    const int i = row * VECTORS + v;
                    const vfloat u = au[v] + bu;
                    const vfloat power = MAD(-u, u, (vfloat)(level));
                    vfloat alpha = min(exp2_polynomial(power), ALPHA_CAP);
                    alpha = (power >= LOG2_ALPHA_MIN) && (number <= last[i]) ? alpha : (vfloat)(0.0f);
                    const vfloat weight = alpha * t[i];
                    const vfloat inverse = 1.0f / (1.0f - alpha);
                    const vfloat after_r = MAD(weight, (vfloat)(red_k), pr[i]);
                    const vfloat after_g = MAD(weight, (vfloat)(green_k), pg[i]);
                    const vfloat after_b = MAD(weight, (vfloat)(blue_k), pb[i]);
                    const vfloat pd_r = MAD(MAD(alpha, r[i], -after_r), inverse, pr[i]);
                    const vfloat pd_g = MAD(MAD(alpha, g[i], -after_g), inverse, pg[i]);
                    const vfloat pd_b = MAD(MAD(alpha, b[i], -after_b), inverse, pb[i]);
                    effect = MAD(pd_r, pd_r + dr[i], effect);
                    effect = MAD(pd_g, pd_g + dg[i], effect);
                    effect = MAD(pd_b, pd_b + db[i], effect);
                    importance += weight;
                    t[i] = MAD(-alpha, t[i], t[i]);
                    pr[i] = after_r;
                    pg[i] = after_g;
                    pb[i] = after_b;
                }
            }
            float effects[LANES], importances[LANES];
            VSTORE(effect, 0, effects);
            VSTORE(importance, 0, importances);
            float2 sum = (float2)(0.0f, 0.0f);
            for (int lane = 0; lane < LANES; ++lane)
                sum += (float2)(effects[lane], importances[lane]);
            const uint e = block_begin + k;
            replace_sums(totals + TOTAL_WORDS * entries[e], sums[e], sum, scale, bound);
            sums[e] = sum;
        }
        const vint done = (vint)((int)(block_end - begin));
        int first = pixel_rows, final = -1;
        for (int row = first_alive; row < end_alive; ++row) {
            vint furthest = last[row * VECTORS];
            for (int v = 1; v < VECTORS; ++v)
                furthest = max(furthest, last[row * VECTORS + v]);
            if (VANY(furthest >= done)) {
                first = min(first, row);
                final = row;
            }
        }
        first_alive = first;
        end_alive = final + 1;
    }
}
