    /* The paper's second half of the removal kernel for GPUs: see removal_prefix_sums_cpu.cl, whose names and order of
       operations these are. */
    float dr[PIXELS], dg[PIXELS], db[PIXELS];
    float pr[PIXELS], pg[PIXELS], pb[PIXELS];
    for (int p = 0; p < PIXELS; ++p) {
        const int row = first_row + p;
        const float left = fabs(t[p]);
        r[p] = mad(left, red, r[p]);
        g[p] = mad(left, green, g[p]);
        b[p] = mad(left, blue, b[p]);
        dr[p] = dg[p] = db[p] = 0.0f;
        if (column < view.width && row < view.height) {
            size_t pixel = 3 * ((size_t)row * view.width + column);
            if (first_time) {
                target[pixel] = r[p];
                target[pixel + 1] = g[p];
                target[pixel + 2] = b[p];
            }
            dr[p] = 2.0f * (r[p] - target[pixel]);
            dg[p] = 2.0f * (g[p] - target[pixel + 1]);
            db[p] = 2.0f * (b[p] - target[pixel + 2]);
        }
        t[p] = 1.0f;
        pr[p] = pg[p] = pb[p] = 0.0f;
    }

    for (uint batch = 0; batch < swept; batch += ITEMS) {
        const uint size = min(swept - batch, (uint)ITEMS);
        barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
        if (lid < size) {
            uint splat = entries[begin + batch + lid];
            float4 s1 = shapes[2 * splat + 1];
            float4 colour = colours[splat];
            near_splat[lid] = splat;
            near_s0[lid] = shapes[2 * splat];
            near_s1[lid] = (float4)(s1.x, s1.y, colour.x, colour.y);
            near_blue[lid] = colour.z;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int group = 0; group < (int)size; group += GROUP_ENTRIES) {
            const int group_end = min(group + GROUP_ENTRIES, (int)size);
            for (int k = group; k < group_end; ++k) {
                float4 s0 = near_s0[k], s1 = near_s1[k];
                float u0 = s0.z * (x - s0.x);
                float effect = 0.0f, importance = 0.0f;
                for (int p = 0; p < PIXELS; ++p) {
                    float dy = first_row + p + 0.5f - s0.y;
                    float u = mad(s0.w, dy, u0);
                    float v = s1.x * dy;
                    float power = s1.y - u * u - v * v;
                    if (power >= LOG2_ALPHA_MIN && (int)batch + k <= last[p]) {
                        float alpha = fmin(EXP2(power), ALPHA_CAP);
                        float weight = alpha * t[p];
                        float inverse = 1.0f / (1.0f - alpha);
                        float after_r = mad(weight, s1.z, pr[p]);
                        float after_g = mad(weight, s1.w, pg[p]);
                        float after_b = mad(weight, near_blue[k], pb[p]);
                        float pd_r = mad(mad(alpha, r[p], -after_r), inverse, pr[p]);
                        float pd_g = mad(mad(alpha, g[p], -after_g), inverse, pg[p]);
                        float pd_b = mad(mad(alpha, b[p], -after_b), inverse, pb[p]);
                        effect = mad(pd_r, pd_r + dr[p], effect);
                        effect = mad(pd_g, pd_g + dg[p], effect);
                        effect = mad(pd_b, pd_b + db[p], effect);
                        importance += weight;
                        t[p] = mad(-alpha, t[p], t[p]);
                        pr[p] = after_r;
                        pg[p] = after_g;
                        pb[p] = after_b;
                    }
                }
                parts[(k - group) * ITEMS + lid] = (float2)(effect, importance);
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            const int entry = lid / 4;
            float2 sum = (float2)(0.0f, 0.0f);
            if (group + entry < group_end)
                for (int j = 0; j < ITEMS / 4; ++j)
                    sum += parts[lid * (ITEMS / 4) + ((j + lid) & (ITEMS / 4 - 1))];
            barrier(CLK_LOCAL_MEM_FENCE);
            parts[lid] = sum;
            barrier(CLK_LOCAL_MEM_FENCE);
            if (lid < group_end - group) {
                float2 after = (parts[4 * lid] + parts[4 * lid + 1]) + (parts[4 * lid + 2] + parts[4 * lid + 3]);
                const uint slot = begin + batch + group + lid;
                replace_sums(totals + TOTAL_WORDS * near_splat[group + lid], sums[slot], after, scale, bound);
                sums[slot] = after;
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
    }
}

