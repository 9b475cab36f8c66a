"""What photographs should show: materials, lights, and the one forward model that goes from them to radiance.

    problem     JointProblem: the observations, the operator and the loss; every question about a point is asked of it
    point       Point: what is asked for, materials and lights
    illumination  one illumination at a point: radiance, residuals, responses of lobes
    jacobian    the derivatives of radiance by everything unknown
    responses   what rows of observations reflect of lobes of weight one; the only caller of the reflection operator
    observed    observations, grouped by illumination, as blocks

How a point is found is no matter here: that is `factorlib.solve`.
"""
