"""`tf2_msgs/msg/TFMessage` for an rclpy whose packages lack it: for serialised messages alone.

The middleware asks a type for its name and whether its size is bounded. Both are taken from a type
that is there and as unbounded, under the name of the one that is missing.
"""

import ctypes

from nav_msgs.msg import Path

# How the middleware asks for its own view of a type, and what namespaces look like in each.
_VIEWS = {
    b"rosidl_typesupport_fastrtps_c": b"tf2_msgs::msg",
    b"rosidl_typesupport_introspection_c": b"tf2_msgs__msg",
}
_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)


class _Support(ctypes.Structure):
    """`rosidl_message_type_support_t`."""

    _fields_ = [
        ("identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("handler", _Handler),
        ("hash", ctypes.c_void_p),
        ("description", ctypes.c_void_p),
        ("sources", ctypes.c_void_p),
    ]


class _Description(ctypes.Structure):
    """What a support's data begins with; more follows, which differs by the view."""

    _fields_ = [
        ("namespace", ctypes.c_char_p),
        ("name", ctypes.c_char_p),
        ("rest", ctypes.c_void_p * 8),
    ]


class _Named(type):
    """What rclpy looks for in the class of a message's class."""

    _TYPE_SUPPORT = None


def _capsule(name: bytes) -> object:
    """Return Path's type support under another name, as the capsule that rclpy wants."""
    Path.__class__.__import_type_support__()
    get, make = ctypes.pythonapi.PyCapsule_GetPointer, ctypes.pythonapi.PyCapsule_New
    get.restype, get.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    make.restype = ctypes.py_object
    make.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    general = get(Path.__class__._TYPE_SUPPORT, None)
    views: dict[bytes, int] = {}
    handler = _Handler(lambda _, view: views.get(view))
    for view, namespace in _VIEWS.items():
        path = _Support.from_address(_Support.from_address(general).handler(general, view))
        description = _Description.from_buffer_copy(_Description.from_address(path.data))
        description.namespace, description.name = namespace, name
        support = _Support.from_buffer_copy(path)
        support.data, support.handler = ctypes.addressof(description), handler
        views[view] = ctypes.addressof(support)
        _kept.extend((support, description, handler))
    return make(views[next(iter(_VIEWS))], None, None)


_kept: list[object] = []  # Python must not free what the middleware reads


class TFMessage(metaclass=_Named):
    """Stands for the type; has no fields."""


_Named._TYPE_SUPPORT = _capsule(b"TFMessage")
for _name in ("CREATE_ROS_MESSAGE", "CONVERT_FROM_PY", "CONVERT_TO_PY", "DESTROY_ROS_MESSAGE"):
    setattr(_Named, f"_{_name}", getattr(Path.__class__, f"_{_name}"))
