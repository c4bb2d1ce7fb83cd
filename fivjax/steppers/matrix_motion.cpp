// Exact motion through contact events under constant friction, for a kernel of one trajectory on a CPU or a GPU.
//
// In one contact mode the motion is then linear: the states at equally spaced later times are matrices times the present state
// (`propagation`). They are samples over a *window* of time ahead, with the Bernstein control points of the guards between them.
// A loop looks at the intervals one after the other and stops at the first that may have an event; only there the Taylor series,
// again a matrix times the state, is searched for the instant. What ends a mode and what follows are the `Laws`, which
// `matrix_kernel` writes out from `contact` and `window`, and puts before this text with the sizes and places that are in capitals.

#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
#define ALWAYS_INLINE CUDA_CALLABLE __forceinline__
#else
#define ALWAYS_INLINE inline __attribute__((always_inline))
#endif

// Numbers side by side: a vector of a processor, or what is computed like one by a GPU.
#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
struct Block {
    double of[BLOCK];
    CUDA_CALLABLE double& operator[](int r) { return of[r]; }
    CUDA_CALLABLE Block operator*(double factor) const {
        Block found;
        for (int r = 0; r < BLOCK; ++r) found.of[r] = of[r] * factor;
        return found;
    }
    CUDA_CALLABLE void operator+=(const Block& other) {
        for (int r = 0; r < BLOCK; ++r) of[r] += other.of[r];
    }
    CUDA_CALLABLE static bool all_above(const Block& numbers, const Block& limits) {
        bool found = true;
        for (int r = 0; r < BLOCK; ++r) found = found && numbers.of[r] > limits.of[r];
        return found;
    }
};
#else
typedef double Block __attribute__((ext_vector_type(BLOCK), aligned(8)));
#endif

struct Motion {
    // An advance: the state and mode after it, its duration (s), whether the section was crossed, whether the mode has ended, and
    // the tangential velocity (m/s) before what happened at its end.
    struct Step {
        double y[2 * N], mode[2], h, last;
        bool crossed, ended;
    };

    ALWAYS_INLINE static double least(double a, double b) { return b < a ? b : a; }
    ALWAYS_INLINE static double most(double a, double b) { return b > a ? b : a; }
    ALWAYS_INLINE static double within(double x, double low, double high) { return least(most(x, low), high); }

    // Products of matrices and a row, block by block from the one that is `first`. ---------------------------------------------

    ALWAYS_INLINE static bool all_above(Block numbers, Block limits) {
#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
        return Block::all_above(numbers, limits);
#else
        return __builtin_reduce_and(numbers > limits) != 0;
#endif
    }

    ALWAYS_INLINE static Block rows_at(const double* column) { return *(const Block*)column; }

    // Of a detached contact all columns count; in contact the last two are zero.
    ALWAYS_INLINE static void product(const double* m, bool open, int first, const double* here, double* found, int size) {
        const double* column = m + BLOCK * COLUMNS * first;
        const int columns = open ? COLUMNS : COLUMNS - 2;
        for (int b = 0; b < size; b += BLOCK) {
            Block sums = rows_at(column) * here[0];
            for (int k = 1; k < columns; ++k) sums += rows_at(column + BLOCK * k) * here[k];
            for (int r = 0; r < BLOCK && b + r < size; ++r) found[b + r] = sums[r];
            column += BLOCK * COLUMNS;
        }
    }

    // What a product gives of the sizes of a row's entries.
    CUDA_CALLABLE static void sizes(const double* m, bool open, const double* here, double* found) {
        double magnitudes[COLUMNS];
        for (int k = 0; k < COLUMNS; ++k) magnitudes[k] = wp::abs(here[k]);
        product(m, open, SIZES, magnitudes, found, BLOCK);
    }
    CUDA_CALLABLE static void guards_at_start(const double* m, bool open, const double* here, double* found) {
        product(m, open, GUARDS, here, found, BLOCK);
    }
    CUDA_CALLABLE static void sample(const double* m, bool open, int i, const double* here, double* found) {
        product(m, open, SAMPLES + OF_SAMPLE * i, here, found, 2 * N);
    }
    CUDA_CALLABLE static void hull(const double* m, bool open, const double* here, double* found) {
        product(m, open, HULL, here, found, HULL_ROWS);
    }
    CUDA_CALLABLE static void guard_series(const double* m, bool open, const double* here, double* found) {
        product(m, open, GUARDS, here, found, GUARD_ROWS);
    }
    CUDA_CALLABLE static void series(const double* m, bool open, const double* here, double* found) {
        product(m, open, DISPLACEMENTS, here, found, SIDE * (ORDER + 2));
    }

    // The first interval that may have an event, or in which the section is crossed. A number of columns that compilers know makes
    // this loop, in which trajectories spend most of their time, faster.
    ALWAYS_INLINE static int scan_of(const double* m, const double* here, Block limits, int proved, int whole, int columns) {
        const double* column = m;
        double speed = here[SPEED];
        int i = 0;
        for (; i < whole; ++i) {
            Block sums = rows_at(column) * here[0];
            for (int k = 1; k < columns; ++k) sums += rows_at(column + BLOCK * k) * here[k];
            if ((i >= proved && !all_above(sums, limits)) || (speed < 0.0 && sums[6] >= 0.0)) break;
            speed = sums[6];
            column += BLOCK * COLUMNS;
        }
        return i;
    }

    // The same, or that in which the time ends.
    CUDA_CALLABLE static int first_interval(const double* m, bool open, const double* mode, const double* here, double steps) {
        double size[BLOCK], start[BLOCK], points[HULL_ROWS];
        sizes(m, open, here, size);
        int whole = steps > 0.0 ? (int)steps : 0, proved = 0;
        guards_at_start(m, open, here, start);
        if (Laws::has_begun(mode, start, size)) {
            // A guard that begins at zero is not above its limits: that it rises is told by its series.
            hull(m, open, here, points);
            if (Laws::is_safe(mode, start, points, size)) proved = 1;
            else whole = 0;
        }
        Block limits;
        for (int r = 0; r < BLOCK; ++r) limits[r] = r < 6 ? size[6 + r % 2] : -INFINITE;
        return open ? scan_of(m, here, limits, proved, whole, COLUMNS) : scan_of(m, here, limits, proved, whole, COLUMNS - 2);
    }

    // Polynomials within an interval, on [0, 1]. -------------------------------------------------------------------------------

    // Value and slope; even and odd powers apart: two short chains of operations that wait for each other instead of a long one.
    ALWAYS_INLINE static double value_of(const double* c, int terms, double x, double* slope) {
        const int last_even = (terms - 1) / 2, last_odd = terms / 2 - 1;
        const double u = x * x;
        double even = c[2 * last_even], even_slope = 0.0, odd = c[2 * last_odd + 1], odd_slope = 0.0;
        for (int k = last_even - 1; k >= 0; --k) {
            even_slope = even_slope * u + even;
            even = even * u + c[2 * k];
        }
        for (int k = last_odd - 1; k >= 0; --k) {
            odd_slope = odd_slope * u + odd;
            odd = odd * u + c[2 * k + 1];
        }
        *slope = odd + 2.0 * (x * even_slope + u * odd_slope);
        return even + x * odd;
    }
    CUDA_CALLABLE static double value_at(const double* c, double x, double* slope) { return value_of(c, ORDER + 1, x, slope); }

    CUDA_CALLABLE static double bent_at(const double* c, double x, double* slope, double* bend) {
        double value = c[ORDER], first = 0.0, second = 0.0;
        for (int k = ORDER - 1; k >= 0; --k) {
            second = second * x + first;
            first = first * x + value;
            value = value * x + c[k];
        }
        *slope = first;
        *bend = 2.0 * second;
        return value;
    }

    // Where a guard is lowest, or the first point where it is seen not to be positive; the start if it is certain to be so
    // everywhere. By Newton's method from the lowest of a few points, as long as it is convex there.
    CUDA_CALLABLE static double lowest_of(const double* c) {
        double least_value = c[0], x = 0.0, slope, bend, others = 0.0;
        for (int k = 1; k < ORDER + 1; ++k) others += wp::abs(c[k]);
        if (c[0] > others) return 0.0;
        for (int k = 1; k <= LOOKS; ++k) {
            const double there = (double)k / LOOKS, value = value_at(c, there, &slope);
            if (value <= 0.0) return there;
            if (value < least_value) {
                least_value = value;
                x = there;
            }
        }
        for (int k = 0; k < LOWEST_STEPS; ++k) {
            if (bent_at(c, x, &slope, &bend) <= 0.0 || !(bend > 0.0)) break;
            x = within(x - slope / bend, 0.0, 1.0);
        }
        return x;
    }

    // The root in the bracket from 0 to `end`, and the slope there: Newton's method, with bisection where it leads away; roots at
    // zero, of which there are `zeros`, do not count. Few terms of the series are enough for the first steps of nearly all roots.
    CUDA_CALLABLE static double root_of(const double* c, double zeros, double guess, double end, double* slope) {
        double low = 0.0, high = end, x = least(guess, end);
        *slope = 0.0;
        for (int count = 0; count < MOST_ROOT_STEPS; ++count) {
            const bool few_terms = count < SHORT_STEPS;
            const double value = few_terms ? value_of(c, SHORT_TERMS, x, slope) : value_at(c, x, slope);
            // The slope of the polynomial with its roots at zero divided out, up to the common factor of value and slope.
            if (x > 0.0) *slope -= zeros * value / x;
            double nearer = *slope != 0.0 ? x - value / *slope : x - value;
            if (few_terms) {
                x = within(nearer, 0.0, end);
                continue;
            }
            // In its bracket the guard falls through its root.
            const bool done = *slope < 0.0 && nearer > 0.0 && nearer <= end && wp::abs(nearer - x) <= 1e-7;
            if (value > 0.0) low = x;
            else high = x;
            if (!done && !(nearer > low && nearer < high)) nearer = 0.5 * (low + high);
            x = within(nearer, 0.0, 1.0);
            if (done) break;
        }
        return x;
    }

    // Where a velocity rises through zero before `end`, where it is `last`. Bisection is seldom needed.
    CUDA_CALLABLE static double rise_of(const double* c, double end, double last) {
        double low = 0.0, high = end, x = end * c[0] / (c[0] - last);
        for (int count = 0; count < RISE_STEPS; ++count) {
            double slope;
            const double value = value_at(c, x, &slope);
            if (value < 0.0) low = x;
            else high = x;
            const double nearer = x - value / (slope == 0.0 ? 1.0 : slope);
            if (nearer >= low && nearer <= high) {
                const bool done = wp::abs(nearer - x) <= 1e-8 * end;
                x = nearer;
                if (done) break;
            } else {
                x = 0.5 * (low + high);
            }
        }
        return x;
    }

    // The largest size of a polynomial near x = 0, for x between `low` and `high`: by Newton's method from the best of a few
    // points, as long as its size is concave there.
    CUDA_CALLABLE static double highest_of(const double* c, double low, double high) {
        double x = 0.0, highest = wp::abs(c[0]), slope, bend;
        for (int k = 0; k <= LOOKS; ++k) {
            const double there = low + (high - low) * k / LOOKS, size = wp::abs(value_at(c, there, &slope));
            if (size > highest) {
                highest = size;
                x = there;
            }
        }
        for (int k = 0; k < PEAK_STEPS; ++k) {
            const double value = bent_at(c, x, &slope, &bend);
            if (!(value * bend < 0.0)) break;
            x = within(x - slope / bend, low, high);
        }
        return most(highest, wp::abs(value_at(c, x, &slope)));
    }

    // The series of a guard; its first coefficients, which are zero up to rounding, are exactly zero.
    CUDA_CALLABLE static void guard(const double* both, int which, int zeros, double* found) {
        for (int k = 0; k < ORDER + 1; ++k) found[k] = k < zeros ? 0.0 : both[2 * k + which];
    }

    // The same with its roots at zero divided out.
    CUDA_CALLABLE static void rest_of_guard(const double* both, int which, int zeros, double* found) {
        for (int k = 0; k < ORDER + 1; ++k) found[k] = k + zeros > ORDER ? 0.0 : both[2 * (k + zeros) + which];
    }

    // The series of the tangential velocity, in m per interval, from those of displacements.
    CUDA_CALLABLE static void speed_series(const double* ahead, double* found) {
        for (int k = 0; k < ORDER + 1; ++k) found[k] = (k + 1) * ahead[SIDE * (k + 1) + TANGENTIAL];
    }

    // Displacements and velocities at a share of an interval: coordinates side by side, and even and odd powers apart.
    CUDA_CALLABLE static void state_at(const double* c, double x, double interval, double* found) {
        const double u = x * x;
        double even[SIDE], even_slope[SIDE], odd[SIDE], odd_slope[SIDE];
        for (int j = 0; j < SIDE; ++j) {
            even[j] = c[SIDE * (ORDER + 1) + j];
            odd[j] = c[SIDE * ORDER + j];
            even_slope[j] = odd_slope[j] = 0.0;
        }
        for (int k = ORDER - 1; k > 0; k -= 2)
            for (int j = 0; j < SIDE; ++j) {
                even_slope[j] = even_slope[j] * u + even[j];
                even[j] = even[j] * u + c[SIDE * k + j];
                odd_slope[j] = odd_slope[j] * u + odd[j];
                odd[j] = odd[j] * u + c[SIDE * (k - 1) + j];
            }
        for (int j = 0; j < N; ++j) {
            even_slope[j] = even_slope[j] * u + even[j];
            even[j] = even[j] * u + c[j];
            found[j] = even[j] + x * odd[j];
            found[N + j] = (odd[j] + 2.0 * (x * even_slope[j] + u * odd_slope[j])) / interval;
        }
    }

    // Motion. -----------------------------------------------------------------------------------------------------------------

    // The place of a mode's matrices among those of a group, and whether the contact is open.
    CUDA_CALLABLE static const double* matrices_of(const double* of_group, const double* mode, bool* open) {
        *open = mode[0] == DETACHED;
        const int place = mode[0] == STICKING ? 0 : *open ? 3 : mode[1] > 0.0 ? 1 : 2;
        return of_group + BLOCK * COLUMNS * TOTAL * (long long)place;
    }

    // To the next event, crossing of the section, end of the time or of the window, whichever comes first.
    CUDA_CALLABLE static void advance(
        const double* of_group, const double* mechanics, double interval, const double* y, const double* mode, double load, double h,
        Step& result
    ) {
        bool open;
        const double* m = matrices_of(of_group, mode, &open);
        const double steps = least(h / interval, (double)INTERVALS);
        double here[COLUMNS], there[COLUMNS], began[2 * N], reached[2 * N];
        Laws::row_of(y, load, here);
        const int i = first_interval(m, open, mode, here, steps);
        if (i > 0) sample(m, open, i, here, began);
        else
            for (int k = 0; k < 2 * N; ++k) began[k] = y[k];
        for (int k = 0; k < 2 * N; ++k) reached[k] = began[k];
        double share = 0.0;
        bool fires[2] = {false, false};
        result.crossed = false;
        if (i < INTERVALS) {
            double both[GUARD_ROWS], size[BLOCK], b[BRACKET];
            Laws::row_of(began, load, there);
            guard_series(m, open, there, both);
            sizes(m, open, there, size);
            Laws::brackets(mode, both, size, b);
            share = least(steps - i, 1.0);
            double root[2] = {INFINITE, INFINITE}, slope[2] = {0.0, 0.0}, same[2] = {0.0, 0.0};
            for (int q = 0; q < 2; ++q) {
                if (b[SPENT + q] > 0.0) continue;
                bool crosses = b[CROSSES + q] > 0.0;
                double c[ORDER + 1], end = b[ENDS + q], guess = b[q], slope_there;
                if (!crosses) {
                    // Positive at both ends, a guard may dip below zero in between. Roots at zero do not count.
                    rest_of_guard(both, q, (int)b[ZEROS + q], c);
                    const double low = lowest_of(c);
                    if (c[0] > 0.0 && value_at(c, low, &slope_there) <= 0.0) {
                        crosses = true;
                        end = low;
                        guess = 0.5 * low;
                    }
                }
                if (crosses) {
                    guard(both, q, (int)b[ZEROS + q], c);
                    root[q] = root_of(c, b[ZEROS + q], guess, end, &slope[q]);
                    same[q] = ROUNDING * (wp::abs(c[0]) + wp::abs(c[1]) + wp::abs(c[2]) + wp::abs(c[3]));
                }
            }
            double first = least(root[0], root[1]);
            // Roots that differ by rounding are one event; the two guards of an open gap always are.
            for (int q = 0; q < 2; ++q)
                fires[q] = root[q] < INFINITE && (root[q] == first || (root[q] - first) * wp::abs(slope[q]) <= same[q]);
            if (b[SPENT] > 0.0 || b[SPENT + 1] > 0.0) {
                first = 0.0;
                for (int q = 0; q < 2; ++q) fires[q] = b[SPENT + q] > 0.0;
            }
            if (first > share) fires[0] = fires[1] = false;
            else if (fires[0] || fires[1]) share = first;
            if (share != 0.0) {
                double ahead[SIDE * (ORDER + 2)], speed[ORDER + 1];
                series(m, open, there, ahead);
                state_at(ahead, share, interval, reached);
                if (began[N + TANGENTIAL] < 0.0 && reached[N + TANGENTIAL] >= 0.0) {
                    result.crossed = true;
                    speed_series(ahead, speed);
                    share = rise_of(speed, share, reached[N + TANGENTIAL] * interval);
                    state_at(ahead, share, interval, reached);
                    reached[N + TANGENTIAL] = 0.0;
                    fires[0] = fires[1] = false;
                }
            }
        }
        result.last = reached[N + TANGENTIAL];
        result.ended = fires[0] || fires[1];
        if (result.ended) {
            const double ending[4] = {load, (double)fires[0], (double)fires[1], RESTING * interval};
            double after[2 * N + 2];
            Laws::next_mode(mechanics, mode, reached, ending, after);
            for (int k = 0; k < 2 * N; ++k) result.y[k] = after[k];
            for (int k = 0; k < 2; ++k) result.mode[k] = after[2 * N + k];
        } else {
            Laws::held(mechanics, mode, reached, result.y);
            for (int k = 0; k < 2; ++k) result.mode[k] = mode[k];
        }
        // An impact may make the velocity jump over zero.
        if (reached[N + TANGENTIAL] < 0.0 && result.y[N + TANGENTIAL] >= 0.0) result.crossed = true;
        result.h = (i + share) * interval;
    }

    // The largest tangential speed next to a sample of the window.
    CUDA_CALLABLE static double highest_near(
        const double* m, bool open, const double* here, double load, int i, double steps, double interval
    ) {
        double about[2 * N], row[COLUMNS], ahead[SIDE * (ORDER + 2)], speed[ORDER + 1];
        sample(m, open, i, here, about);
        Laws::row_of(about, load, row);
        series(m, open, row, ahead);
        speed_series(ahead, speed);
        return highest_of(speed, most(-(double)i, -1.0), least(steps - i, 1.0)) / interval;
    }

    // The largest tangential speed (m/s) on the way of an advance from a state, or the one from before if that was larger.
    CUDA_CALLABLE static double peak(
        const double* of_group, double interval, const double* y, const double* mode, double load, const Step& after, double before
    ) {
        bool open;
        const double* m = matrices_of(of_group, mode, &open);
        const double steps = after.h / interval;
        double here[COLUMNS], speeds[INTERVALS + 1], turned[INTERVALS + 1];
        Laws::row_of(y, load, here);
        speeds[0] = here[SPEED];
        for (int i = 0; i < INTERVALS; ++i) {
            const double* column = m + 6 + BLOCK * COLUMNS * i;
            double sum = 0.0;
            for (int k = 0; k < COLUMNS; ++k) sum += column[BLOCK * k] * here[k];
            speeds[i + 1] = sum;
        }
        // A parabola through three samples rises by less than half of their second difference above the highest of them. So most
        // advances have no higher peak than those before. One within the first interval has its third sample behind it.
        double highest = most(before, wp::abs(after.last));
        const int last = steps >= INTERVALS - 1 ? INTERVALS : steps > 0.0 ? (int)steps + 1 : 1;
        double rough = most(wp::abs(speeds[0]), wp::abs(speeds[last])), bend = 0.0;
        const int inner = last > 1 ? last : 2;
        for (int k = 1; k < inner; ++k) {
            rough = most(rough, wp::abs(speeds[k]));
            bend = most(bend, wp::abs(speeds[k + 1] - 2.0 * speeds[k] + speeds[k - 1]));
        }
        if (rough + 0.5 * bend <= highest) return highest;
        for (int k = 0; k <= INTERVALS; ++k) {
            turned[k] = -speeds[k];
            if (k <= steps) highest = most(highest, wp::abs(speeds[k]));
        }
        // Parabolas through three samples tell peaks apart. Next to a sample that is much slower than others there is no highest.
        for (int side = 0; side < 2; ++side) {
            const double* own = side ? turned : speeds;
            const int place = (int)Laws::fastest_sample(own, &steps);
            if (own[place] > 0.5 * highest) highest = most(highest, highest_near(m, open, here, load, place, steps, interval));
        }
        return highest;
    }
};
