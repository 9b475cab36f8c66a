"""The comparison of methods: an object photographed in some lights, four baselines, and what each predicts of photos that were not taken.

case         a method and what it sees;  body: the object, and what of it a camera sees;  photos: what was photographed
scene        radiance of the object, by quadrature;  prediction: what a method answers
projective, intrinsic, grey   baselines of a few lines;  joint: Mitsuba's optimisation;  solved: the stage `solve`
score        errors against the truth;  show: pictures of them
"""
