"""The vocabulary of photogrammetry with its geometry: numpy only, no files, no clocks, no devices.

Conventions, which hold in the whole project:

image space
    x right, y up, z towards the viewer; the camera looks along -z. Image points are (column, row) in pixels, columns to
    the right, rows down; (0, 0) is the *centre* of the upper left pixel.
rotation
    ``R_object_from_image = Rx(omega) Ry(phi) Rz(kappa)`` in radians; degrees only in files, names then end in ``_deg``.
distortion
    Brown's model from ideal to distorted normalised coordinates, y down: K1, K2, K3 radial, P1, P2 decentring.
object space
    a local east-north-up frame in metres. Geodetic and projected coordinates only at the border, see ``frames``.
height
    the name says which: ``height_ellipsoid_m``, ``height_geoid_m``, ``height_above_ground_m``.
time
    GPS time in integer nanoseconds, ``gps_time_ns``; the monotonic time of a computer beside it, ``host_time_ns``.
precision
    ``sigma_*`` and ``covariance_*``: a priori on observations, a posteriori on results.
names of transformations
    ``target_from_source``: neighbours in a product must match.
"""
