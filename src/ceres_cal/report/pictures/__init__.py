"""Pictures made of photographs: straightened, seen from above to scale, and with the model drawn into them.

The names are loaded when they are first used; everything here needs OpenCV.
"""
