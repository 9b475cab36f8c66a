"""Normals by shading: what the mesh leaves open, the photos decide, all photos of a mesh together.

turns    how normals turn, and one step of it with the lights eliminated
choice   whether a surface is turned, and how stiff it is, by photos that had no part in it
"""
