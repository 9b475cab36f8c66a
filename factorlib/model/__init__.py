"""What photographs should show: materials, lights, and the one forward model that goes from them to radiance.

    problem       JointProblem: the observations, the operator and the loss; it answers every question about a point
    point         Point: the unknowns, which are materials and lights
    illumination  one illumination at a point: radiance, residuals, responses of lobes
    jacobian      the derivatives of radiance by all unknowns
    responses     what observations reflect of lobes of weight one; the only caller of the reflection operator
    observed      observations, grouped by illumination, as blocks

`factorlib.solve` finds the best point.
"""
