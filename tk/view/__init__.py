"""A result in a window of Open3D, drawn with OpenGL: `tk view`.

OpenGL runs on every machine with a display, also without a graphics card. Open3D's other window needs Vulkan, does not
finish its images on a processor, and aborts the process where no Vulkan driver is installed.
"""
