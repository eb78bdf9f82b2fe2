"""Frames as a camera gives them: the newest are used, the others are counted, and every stage is timed."""

from logvggt_jax.reconstruction.live.online import OnlineSettings, online_stream
from logvggt_jax.reconstruction.live.recording import Recording
from logvggt_jax.reconstruction.live.report import LiveReport
from logvggt_jax.reconstruction.live.session import LiveSession
from logvggt_jax.reconstruction.watching import LiveResult

__all__ = ["LiveReport", "LiveResult", "LiveSession", "OnlineSettings", "Recording", "online_stream"]
