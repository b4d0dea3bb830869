    /* The paper's second half of the removal kernel for GPUs: see removal_prefix_sums_cpu.cl, whose names and order of
       operations these are. From here on r, g, b are the final colour, and behind_r, behind_g, behind_b the colour before
       a splat. */
    Mine mine = pixels_of(lid / SHARE, origin, lid);
    int end = 0;
    for (int p = 0; p < PIXELS; ++p) {
        const int i = mine.first + p * SHARE;
        const float left = fabs(state.t[i]);
        state.r[i] = MAD(left, red, state.r[i]);
        state.g[i] = MAD(left, green, state.g[i]);
        state.b[i] = MAD(left, blue, state.b[i]);
        if (first_time && inside(mine, p, picture)) {
            global float *pixel = target + 3 * (views->first_pixel + pixel_number(mine, p, picture));
            pixel[0] = state.r[i];
            pixel[1] = state.g[i];
            pixel[2] = state.b[i];
        }
        state.t[i] = 1.0f;
        behind_r[i] = behind_g[i] = behind_b[i] = 0.0f;
        end = max(end, state.last[i] + 1);
    }
    if (swept == 0)
        return;
    end_subtile(&walk, mine.subtile, end);
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (lid < SUBTILES)
        batch.places[lid] = 0;

    local PART *parts = walk.parts + lid / SHARE * SUBTILE_PARTS;
    int turn = 0;
    for (first = 0; first < swept; first += BATCH) {
        const int size = min(swept - first, (uint)BATCH);
        fetch(&batch, shapes, colours, intersections + first, subtiles + first, size, lid);
        barrier(CLK_LOCAL_MEM_FENCE);
        make_lists(&batch, lid);
        mine = pixels_of(batch.dealt[lid / SHARE], origin, lid);
        local const uchar *list = batch.lists + mine.subtile * LIST_ROOM;
        const int count = batch.counts[mine.subtile];
        const int place = batch.places[mine.subtile];
        const int left = intersections_left(&walk, mine.subtile, place, count, turn, lid);
        float t[PIXELS], r[PIXELS], g[PIXELS], b[PIXELS];
        float dr[PIXELS], dg[PIXELS], db[PIXELS], pr[PIXELS], pg[PIXELS], pb[PIXELS];
        int last[PIXELS];
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            t[p] = state.t[i];
            r[p] = state.r[i];
            g[p] = state.g[i];
            b[p] = state.b[i];
            last[p] = state.last[i];
            pr[p] = behind_r[i];
            pg[p] = behind_g[i];
            pb[p] = behind_b[i];
            dr[p] = dg[p] = db[p] = 0.0f;
            if (inside(mine, p, picture)) {
                global const float *pixel = target + 3 * (views->first_pixel + pixel_number(mine, p, picture));
                dr[p] = 2.0f * (r[p] - pixel[0]);
                dg[p] = 2.0f * (g[p] - pixel[1]);
                db[p] = 2.0f * (b[p] - pixel[2]);
            }
        }
        clear_sums(&walk, lid);
        barrier(CLK_LOCAL_MEM_FENCE);
        const int rounds = agree_on_rounds(&walk, &turn, lid);
        if (share == 0)
            batch.places[mine.subtile] = place + places(count);
        for (int done = 0; done < rounds * ROUND; done += ROUND) {
            const int now = min(left - done, ROUND);
            for (int j = 0; j < now; ++j) {
                const int i = done + j;
                local const float4 *splat = batch.shapes + 3 * list[i];
                const float4 s0 = splat[0], s1 = splat[1];
                const float blue_k = splat[2].x;
                const float u0 = s0.z * (mine.x - s0.x);
                float effect = 0.0f, importance = 0.0f;
                for (int p = 0; p < PIXELS; ++p) {
                    const float power = power_at(mine, p, u0, s0, s1);
                    if (power >= LOG2_ALPHA_MIN && place + i <= last[p]) {
                        const float alpha = fmin(EXP2(power), ALPHA_CAP);
                        const float weight_k = alpha * t[p];
                        const float inverse = 1.0f / (1.0f - alpha);
                        const float after_r = MAD(weight_k, s1.z, pr[p]);
                        const float after_g = MAD(weight_k, s1.w, pg[p]);
                        const float after_b = MAD(weight_k, blue_k, pb[p]);
                        const float pd_r = MAD(MAD(alpha, r[p], -after_r), inverse, pr[p]);
                        const float pd_g = MAD(MAD(alpha, g[p], -after_g), inverse, pg[p]);
                        const float pd_b = MAD(MAD(alpha, b[p], -after_b), inverse, pb[p]);
                        effect = MAD(pd_r, pd_r + dr[p], effect);
                        effect = MAD(pd_g, pd_g + dg[p], effect);
                        effect = MAD(pd_b, pd_b + db[p], effect);
                        importance += weight_k;
                        t[p] = MAD(-alpha, t[p], t[p]);
                        pr[p] = after_r;
                        pg[p] = after_g;
                        pb[p] = after_b;
                    }
                }
                parts[j * SHARE + share] = (float2)(effect, importance);
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            const int summed = summed_splat(share);
            if (summed < now) {
                const float2 sum = clamp(sum_parts(parts, share), -view_bound / SUBTILES, view_bound / SUBTILES);
                add_to_sums(&walk, list[done + summed], sum);
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            state.t[i] = t[p];
            behind_r[i] = pr[p];
            behind_g[i] = pg[p];
            behind_b[i] = pb[p];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = lid; i < size; i += ITEMS) {
            const float2 before = sums[first + i], after = sums_of(&walk, i);
            replace_sums(totals + TOTAL_WORDS * (size_t)batch.splats[i], before, after, view_scale, view_bound);
            sums[first + i] = after;
        }
    }
}

