/* Stands in for Python's own header where that is not installed, as many systems package it apart (python3-dev).
 * It declares what cffi's extensions call, of the stable ABI alone, which is the same in every Python 3 from 3.2 on with
 * a global interpreter lock: https://docs.python.org/3/c-api/stable.html */
#ifndef MAGSHELL_PYTHON_H
#define MAGSHELL_PYTHON_H
#include <assert.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <wchar.h>

#define PY_MAJOR_VERSION 3

typedef ssize_t Py_ssize_t;
typedef struct _object PyObject;
typedef struct _ts PyThreadState;

extern PyObject _Py_NoneStruct; /* of no known size here: only its address is taken */
#define Py_None (&_Py_NoneStruct)
#define PyMODINIT_FUNC __attribute__((visibility("default"))) PyObject *

void Py_IncRef(PyObject *);
void Py_DecRef(PyObject *);
#define Py_INCREF(o) Py_IncRef((PyObject *)(o))
#define Py_DECREF(o) Py_DecRef((PyObject *)(o))
#define Py_XINCREF(o) Py_IncRef((PyObject *)(o))
#define Py_XDECREF(o) Py_DecRef((PyObject *)(o))

PyThreadState *PyEval_SaveThread(void);
void PyEval_RestoreThread(PyThreadState *);
#define Py_BEGIN_ALLOW_THREADS { PyThreadState *_save = PyEval_SaveThread();
#define Py_END_ALLOW_THREADS PyEval_RestoreThread(_save); }

void Py_FatalError(const char *) __attribute__((noreturn));
PyObject *PyErr_Occurred(void);
int PyArg_UnpackTuple(PyObject *, const char *, Py_ssize_t, Py_ssize_t, ...);
PyObject *PyImport_ImportModule(const char *);
PyObject *PyObject_CallMethod(PyObject *, const char *, const char *, ...);
void *PyObject_Malloc(size_t);
void PyObject_Free(void *);

PyObject *PyBool_FromLong(long);
PyObject *PyFloat_FromDouble(double);
double PyFloat_AsDouble(PyObject *);
PyObject *PyLong_FromLong(long);
PyObject *PyLong_FromUnsignedLong(unsigned long);
PyObject *PyLong_FromLongLong(long long);
PyObject *PyLong_FromUnsignedLongLong(unsigned long long);
PyObject *PyLong_FromVoidPtr(void *);
#endif
