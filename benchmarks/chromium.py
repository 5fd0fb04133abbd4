"""Where a Chromium is that draws pages without a screen; the tests look here too."""

import shutil

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
