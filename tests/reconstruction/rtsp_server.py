"""An RTSP server of GStreamer's own: shows a moving ball as H.264 under the address `/ball`, once somebody looks.

Runs in the system's Python, which has GStreamer's bindings, and is given to it on standard input; its argument is the
port, and it prints `ready`.
"""

from __future__ import annotations

import sys

import gi  # type: ignore[import-not-found]

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # type: ignore[import-not-found]  # noqa: E402

_PIPELINE = (
    "( videotestsrc is-live=true pattern=ball ! video/x-raw,width=84,height=56,framerate=15/1 "
    "! x264enc tune=zerolatency speed-preset=ultrafast key-int-max=15 ! rtph264pay name=pay0 pt=96 config-interval=1 )"
)

Gst.init(None)
server = GstRtspServer.RTSPServer()
server.set_address("127.0.0.1")
server.set_service(sys.argv[1])
factory = GstRtspServer.RTSPMediaFactory()
factory.set_launch(_PIPELINE)
server.get_mount_points().add_factory("/ball", factory)
if not Gst.ElementFactory.find("x264enc") or not server.attach(None):
    sys.exit("GStreamer lacks x264enc, or the port is taken")
print("ready", flush=True)
GLib.MainLoop().run()
