"""The camera itself: intrinsics from a ChArUco board (`charuco`) or from EXIF data (`exif`)."""
