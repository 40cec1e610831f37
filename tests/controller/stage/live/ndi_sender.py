"""A source of NDI in one colour: ndi_sender.py NAME, until its input ends."""

import sys
import threading
import time
from fractions import Fraction

import numpy as np
from cyndilib.sender import Sender
from cyndilib.video_frame import VideoSendFrame
from cyndilib.wrapper.ndi_structs import FourCC

WIDTH, HEIGHT = 160, 120
frame = VideoSendFrame()
frame.set_resolution(WIDTH, HEIGHT)
frame.set_frame_rate(Fraction(25, 1))
frame.set_fourcc(FourCC.BGRX)
sender = Sender(sys.argv[1])
sender.set_video_frame(frame)
picture = np.empty((HEIGHT, WIDTH, 4), np.uint8)
picture[:] = (192, 128, 64, 255)
over = threading.Thread(target=sys.stdin.read)
over.start()
with sender:
    while over.is_alive():
        sender.write_video_async(picture.ravel())
        time.sleep(0.04)
