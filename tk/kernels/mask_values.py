"""Values of masks; without Taichi, for modules that need no kernel."""

#: a pixel that shows another person, who may hide this one. Other pixels are 0 or 255, and the coarser scales are their
#: means over 4 and 16 pixels, so none of them has this value.
OTHERS = 1

#: least value of a pixel that shows the person: half of 255, because video coding blurs edges, and coarser scales are
#: means
PERSON = 128
