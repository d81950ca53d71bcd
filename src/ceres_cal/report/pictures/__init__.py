"""Pictures made from photographs: straightened, seen from above to scale, and with the model drawn into them.

Names are imported when they are first used; everything here needs OpenCV.
"""
