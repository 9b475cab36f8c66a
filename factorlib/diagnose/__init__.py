"""What the data can and cannot say about an answer.

uncertainty      standard errors of the materials
coverage         standard errors of a light's radiance, direction by direction
identifiability  what no solve can find from these observations, and what this answer leaves open, as sentences
warnings         what is missing or unusable in the observations, as sentences
"""
