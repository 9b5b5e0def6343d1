"""Voxel radiance fields: the appearance model of PAC-NeRF (Li et al. 2023), with which this project is compared."""
