"""Control of the dome and the probe: wire protocol, transport, sequence, safety,
cameras and sessions.
"""
