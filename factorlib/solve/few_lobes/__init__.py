"""Lights as few lobes with free axes and sharpnesses, found by insertion: a solver of its own, for scenes that the model shows exactly.

Where normals, shadows and noise are what the model says, a light of few lobes is found to the last digit, sun and all.  On photographs lobes
take up the errors of the model as features of the light, so this solver decides nothing for the default one: it takes shadows and
interreflection as the problem has them, photos as linear, and has no prior on lights but the paper's on their tint.

    solve      few_lobes: rounds, the choice of specular parts, polish
    rounds     lobes are inserted where residuals are large (insertion), as long as held-out observations are explained better;
               roughness is also searched for with the lights fixed
    descent    Levenberg–Marquardt on the system of all lights (`factorlib.solve.arrow`)
    equations  of one light: derivatives, normal equations, weights;  unknowns: of a light as few lobes, 6 a lobe
"""
