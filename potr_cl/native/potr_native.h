/* What the native path's sources share. NumPy functions are the reference (table.py): both give the same integers and
 * floats, bit for bit. What files hold, docs/format.md describes.
 *
 * Rules: nothing that comes from a file is trusted; every function is told how long its arrays are, and the Python
 * that calls it has checked that they are as long as it says. No function allocates memory, keeps state
 * between calls, or knows of Python, which calls them through ctypes, which leaves the interpreter free meanwhile.
 */

#ifndef POTR_NATIVE_H
#define POTR_NATIVE_H

#include <float.h>
#include <stddef.h>
#include <stdint.h>

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the native path is for little-endian machines; without it the package works all the same"
#endif

#if FLT_EVAL_METHOD != 0
#error "floats are computed in more digits than they have here, which makes other numbers of the same file"
#endif

#if defined(POTR_SMALL)
#define INLINE inline
#elif defined(_MSC_VER)
#define INLINE __forceinline
#else
#define INLINE inline __attribute__((always_inline))
#endif

#if defined(_WIN32)
#define POTR_EXPORT __declspec(dllexport)
#else
#define POTR_EXPORT __attribute__((visibility("default")))
#endif

/* Loops whose vectors profit from wider registers than every processor has: compiled for several, and chosen when the
 * library is loaded. Floats too: the wider version has no instruction that multiplies and adds at once (that is not part
 * of AVX2), and the build forbids to fuse them anyway. */
#if defined(__x86_64__) && defined(__linux__) && defined(__GLIBC__) && !defined(POTR_SANITIZED) \
    && defined(__GNUC__) && !defined(__clang__) /* which refuses it for functions that a library shows */
#define POTR_WIDE __attribute__((target_clones("default", "avx2")))
#else
#define POTR_WIDE
#endif

#endif
