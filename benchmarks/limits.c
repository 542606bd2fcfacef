/* The integrators of baseline.c, and loops that each load one unit of the processor.

`rate` loops make one instruction on SEVERAL independent numbers, `latency` loops make it on one
number, each on the result of the last; both for vectors and for single numbers. An empty assembler
statement hides a value from the compiler, which therefore keeps every instruction. Memory loops
read or write `count` vectors of an array, again and again. */

#include "baseline.c"

#if defined(__aarch64__)
#define HIDE(x) __asm__ volatile("" : "+w"(x))
#else
#define HIDE(x) __asm__ volatile("" : "+v"(x))
#endif

#define SEVERAL 12

#define DEFINE_LOOP(type, name, count, operation)                                                  \
    double name(long rounds)                                                                       \
    {                                                                                              \
        type x[count], b = (type){0} + 0.5, c = (type){0} + 1.0;                                   \
        UNROLL for (int i = 0; i < (count); i++)                                                   \
            x[i] = c + (0.25 + i);                                                                 \
        HIDE(b);                                                                                   \
        HIDE(c);                                                                                   \
        for (long k = 0; k < rounds; k++)                                                          \
            UNROLL for (int i = 0; i < (count); i++) {                                             \
                operation;                                                                         \
                HIDE(x[i]);                                                                        \
            }                                                                                      \
        type sum = b + c;                                                                          \
        UNROLL for (int i = 0; i < (count); i++)                                                   \
            sum += x[i];                                                                           \
        HIDE(sum);                                                                                 \
        return 0.0;                                                                                \
    }

#define DEFINE_BOTH(type, kind, name, operation)                                                   \
    DEFINE_LOOP(type, kind##_rate_##name, SEVERAL, operation)                                      \
    DEFINE_LOOP(type, kind##_latency_##name, 1, operation)

/* The fixed points are 2, 1, ...: no overflow, and no subnormal number. */
#define DEFINE_UNITS(type, kind, root, greater)                                                    \
    DEFINE_BOTH(type, kind, fma, x[i] = x[i] * b + c)                                              \
    DEFINE_BOTH(type, kind, mul, x[i] = x[i] * c)                                                  \
    DEFINE_BOTH(type, kind, add, x[i] = x[i] + b)                                                  \
    DEFINE_BOTH(type, kind, max, x[i] = greater(x[i], c))                                          \
    DEFINE_BOTH(type, kind, div, x[i] = c / x[i])                                                  \
    DEFINE_BOTH(type, kind, sqrt, x[i] = root(x[i]))                                               \
    DEFINE_LOOP(type, kind##_latency_memory, 1, volatile type slot = x[i]; x[i] = slot)            \
    DEFINE_LOOP(type, kind##_rate_mix, SEVERAL, if (i % 2) x[i] = x[i] * b + c; else x[i] = x[i] + b)

DEFINE_UNITS(vector, vector, vector_sqrt, vector_max)
DEFINE_UNITS(double, single, sqrt, double_max)
DEFINE_LOOP(vector, vector_rate_sin, 1, x[i] = vector_sin(b); HIDE(b))
DEFINE_LOOP(vector, vector_rate_cos, 1, x[i] = vector_cos(b); HIDE(b))
DEFINE_LOOP(double, single_rate_sin, 1, x[i] = sin(b); HIDE(b))
DEFINE_LOOP(double, single_rate_cos, 1, x[i] = cos(b); HIDE(b))

#define DEFINE_MEMORY(name, before, body, after)                                                   \
    void memory_##name(long rounds, long count, double *a)                                         \
    {                                                                                              \
        vector x = (vector){0} + 1.0, s0 = x, s1 = x, s2 = x, s3 = x;                              \
        for (long k = 0; k < rounds; k++) {                                                        \
            for (long i = 0; i < count * WIDTH; i += 4 * WIDTH) {                                  \
                double *to = a + i;                                                                \
                body                                                                               \
                __asm__ volatile("" : : : "memory");                                               \
            }                                                                                      \
        }                                                                                          \
        after;                                                                                     \
        s0 += s1 + s2 + s3;                                                                        \
        HIDE(s0);                                                                                  \
    }

#define FOUR(statement)                                                                            \
    { statement(0, s0) } { statement(1, s1) } { statement(2, s2) } { statement(3, s3) }
#define READ(j, s) s = vector_load(to + (j) * WIDTH); HIDE(s);
#define WRITE(j, s) vector_store(to + (j) * WIDTH, x);
#if defined(__AVX512F__)
#define STREAM(j, s) _mm512_stream_pd(to + (j) * WIDTH, (__m512d)x);
#elif defined(__AVX__)
#define STREAM(j, s) _mm256_stream_pd(to + (j) * WIDTH, (__m256d)x);
#else
#define STREAM WRITE
#endif

DEFINE_MEMORY(read, , FOUR(READ), )
DEFINE_MEMORY(write, , FOUR(WRITE), )
DEFINE_MEMORY(stream, , FOUR(STREAM), __asm__ volatile("" : : : "memory"))
