/* The module potr_cl.native._library: empty for Python, which only builds and finds it. Its functions are those
 * of the other sources, and are called through ctypes. So it needs next to nothing of Python's C interface, and one
 * library serves all versions of Python. */

#define Py_LIMITED_API 0x030A0000
#include <Python.h>

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_library", "The native path; see potr_cl.native.", 0, NULL, NULL, NULL,
    NULL, NULL
};

PyMODINIT_FUNC PyInit__library(void)
{
    return PyModule_Create(&definition);
}
