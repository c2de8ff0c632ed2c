/* The module kbmaps._kernels: the types Net and RigidFilter. */
#include "common.h"

extern PyType_Spec net_spec, filter_spec;

static int add_types(PyObject *module)
{
    PyType_Spec *specs[] = {&net_spec, &filter_spec};
    for (int i = 0; i < 2; i++) {
        PyObject *type = PyType_FromModuleAndSpec(module, specs[i], NULL);
        if (type == NULL || PyModule_AddType(module, (PyTypeObject *)type) < 0) {
            Py_XDECREF(type);
            return -1;
        }
        Py_DECREF(type);
    }
    return 0;
}

static PyModuleDef_Slot slots[] = {{Py_mod_exec, add_types}, {0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "kbmaps._kernels", "Compiled twins of kbmaps' NumPy loops.", 0, NULL, slots, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__kernels(void)
{
    return PyModuleDef_Init(&definition);
}
