"""What the robot's sensors report of its motion, a module a sensor.

Every sensor draws from its own named and seeded stream, so that a change of one leaves the noise of the
others unchanged. With `noiseless` the numbers are exact at the integrator's accuracy: no noise, bias,
quantisation or vibration.

Rates and increments are means over the interval that ends at the time stamp: a gyro sample times the
interval is the exact rotation, an accelerometer sample times the interval the exact change of velocity less
gravity, in the axes of the body at the start of the interval (as strapdown preintegration expects).
"""
