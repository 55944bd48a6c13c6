"""What there is to draw on and with: a display, and a graphics card behind Vulkan."""

from __future__ import annotations

import ctypes
import os
import struct
import sys

from tk.errors import DisplayError

_OTHERWISE = "without one, tk render draws a video"
# VkInstanceCreateInfo: its type's number, and nothing asked for
_INSTANCE = struct.pack("@iPIPIPIP", 1, 0, 0, 0, 0, 0, 0, 0)
_CPU = 4  # VK_PHYSICAL_DEVICE_TYPE_CPU
_PROPERTIES_BYTES = 4096  # more than VkPhysicalDeviceProperties takes


def require_display() -> None:
    """Raise DisplayError where there is no display: without one Open3D waits for ever, or ends the process."""
    if sys.platform != "linux":
        return
    if not os.environ.get("DISPLAY"):
        wayland = " (Wayland alone does not do: Open3D needs XWayland)" if os.environ.get("WAYLAND_DISPLAY") else ""
        raise DisplayError(f"tk view: there is no display, for DISPLAY is not set{wayland}; {_OTHERWISE}")
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError as error:
        raise DisplayError(f"tk view: {error}; install libx11-6; {_OTHERWISE}") from None
    x11.XOpenDisplay.restype, x11.XOpenDisplay.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    handle = x11.XOpenDisplay(None)
    if not handle:
        raise DisplayError(f"tk view: the display {os.environ['DISPLAY']} cannot be opened; {_OTHERWISE}")
    x11.XCloseDisplay(handle)


def has_graphics_card() -> bool:
    """Whether Vulkan finds a device that is not the processor itself; True where nobody can say.

    Mesa's Vulkan on the processor (22.3) never finishes some of the pictures of Open3D's window.
    """
    if sys.platform != "linux":
        return True
    try:
        vulkan = ctypes.CDLL("libvulkan.so.1")
    except OSError:
        return False
    instance, count = ctypes.c_void_p(), ctypes.c_uint32()
    if vulkan.vkCreateInstance(_INSTANCE, None, ctypes.byref(instance)):
        return False
    try:
        if vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None):
            return False
        devices = (ctypes.c_void_p * count.value)()
        vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), devices)
        properties = ctypes.create_string_buffer(_PROPERTIES_BYTES)
        for device in devices:
            vulkan.vkGetPhysicalDeviceProperties(ctypes.c_void_p(device), properties)
            # versions of the interface and the driver, numbers of the vendor and the device, its type
            if struct.unpack_from("5I", properties)[4] != _CPU:
                return True
        return False
    finally:
        vulkan.vkDestroyInstance(instance, None)
