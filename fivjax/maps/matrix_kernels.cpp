// What a kernel does for one lane, after `steppers/matrix_motion.cpp`: a trajectory for some steps, or a state to its crossings of
// the section. What belongs to a lane is a row of numbers, which is changed in place; the columns in capitals are said in
// `matrix_kernels`.

const long long group = ((const int*)groups)[lane];
const double* of_group = (const double*)matrices + 4LL * BLOCK * COLUMNS * TOTAL * group;
const double* own = (const double*)mechanics + NUMBERS * group;
const double interval = ((const double*)intervals)[group];
double* row = (double*)rows + (long long)lane * width;
Motion::Step after;
double y[2 * N], mode[2];

if (to_section) {
    double *past = (double*)path + 2LL * N * kept * lane, left = row[LONGEST], top = 0.0;
    for (int k = 0; k < 2 * N; ++k) y[k] = row[STATE + k];
    mode[0] = row[STATUS];
    mode[1] = row[DIRECTION];
    int ended = 0, crossed = 0, since = 0;
    while (left > 0.0 && crossed < row[CROSSINGS] && since < MOST_SEGMENTS) {
        Motion::advance(of_group, own, interval, y, mode, 0.0, left, after);
        if (peaks) top = Motion::peak(of_group, interval, y, mode, 0.0, after, top);
        for (int k = 0; k < 2 * N; ++k) y[k] = after.y[k];
        for (int k = 0; k < 2; ++k) mode[k] = after.mode[k];
        ended += after.ended;
        // No number ends it, too.
        left = after.h < left ? left - after.h : 0.0;
        ++since;
        if (after.crossed) {
            since = 0;
            for (int k = 0; k < 2 * N; ++k) past[2 * N * (crossed % kept) + k] = y[k];
            ++crossed;
        }
    }
    for (int k = 0; k < 2 * N; ++k) row[STATE + k] = y[k];
    row[STATUS] = mode[0];
    row[DIRECTION] = mode[1];
    row[EVENTS] = ended;
    row[CROSSED] = crossed;
    row[TIME] = row[LONGEST] - left;
    row[PEAK] = top;
} else {
    const int* at = (const int*)columns;
    const double *jumps = row + at[JUMPS], *loads = row + at[LOADS];
    double *crossing = row + at[CROSSING], t = row[at[T]];
    for (int k = 0; k < 2 * N; ++k) y[k] = row[at[Y] + k];
    mode[0] = row[at[MODE]];
    mode[1] = row[at[MODE_DIRECTION]];
    for (int step = 0; step < steps; ++step) {
        int past = 0;
        for (int k = 0; k < count_of_jumps; ++k) past += jumps[k] <= t;
        const double until = past < count_of_jumps ? jumps[past] : INFINITE;
        Motion::advance(of_group, own, interval, y, mode, loads[past], until - t, after);
        t = after.h >= until - t ? until : t + after.h;
        if (after.mode[0] != mode[0]) {
            row[at[STATUS_CHANGES]] += 1.0;
            row[at[LAST_CHANGE]] = t;
        }
        for (int k = 0; k < 2 * N; ++k) y[k] = after.y[k];
        for (int k = 0; k < 2; ++k) mode[k] = after.mode[k];
        // Crossings during the kick do not count for the motion after it.
        if (after.crossed && past == count_of_jumps)
            for (int k = 0; k < 2 * N; ++k) crossing[k] = y[k];
    }
    row[at[T]] = t;
    for (int k = 0; k < 2 * N; ++k) row[at[Y] + k] = y[k];
    row[at[MODE]] = mode[0];
    row[at[MODE_DIRECTION]] = mode[1];
}
