"""What photographs should show: materials, lights, and the one forward model that goes from them to radiance.

    problem       JointProblem: the observations, the operator and the loss; it answers every question about a point
    point         Point: the unknowns, which are materials and lights
    illumination  one illumination at a point: radiance, residuals, and their derivatives by all unknowns
    lights        a light: log radiance on cells of the sphere, which may split
    responses     what observations reflect of lobes of weight one; the main solver's only caller of the reflection operator;  reflected: tabulated
    observed      observations, grouped by illumination, as blocks

`factorlib.solve` finds the best point.
"""
