"""An independent simulator of robot and ground, batched over runs, which shares no equation with the twin.

It takes from the twin only records of parameters (vehicle, soil). What differs: the contact is that of Wong
and Reece (1967) with Lyasko's (2010) slip sinkage and a shear law with a hump (Wong and Preston-Thomas
1983); slip forces follow by a relaxation length; loads move with acceleration; the ground is patchy; the
integrator is linearly implicit with secant coefficients.
"""
