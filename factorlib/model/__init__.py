"""What photographs should show: materials, lights, and the one forward model that goes from them to radiance.

    problem       JointProblem: the observations, the operator and the loss; it answers every question about a point
    materials     the unknowns: materials, and Point, which is materials and lights
    lights        a light: log radiance on cells of the sphere, which may split
    illumination  one illumination at a point: radiance, residuals, and their derivatives by all unknowns
    responses     what observations reflect of lobes of weight one; the main solver's only caller of the reflection operator
    observed      observations, grouped by illumination, as blocks

`factorlib.solve` finds the best point.
"""
