"""Compile Warp kernels once, by using each of them on a handful of particles.

Two processes that start at the same time would otherwise compile the same kernels twice. One module a group, so that
a change of one group does not touch what depends on another; each has ``compile_kernels(device)``.
"""
