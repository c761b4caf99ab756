/* Stands in for Python's own header where that is not installed; see Python.h beside it. */
#define HAVE_WCHAR_H 1
