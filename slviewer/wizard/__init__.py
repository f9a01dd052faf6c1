"""The wizard's state machine without a browser: requests go in, a frozen snapshot comes out, threads do the work.

`operator.Operator` takes every request. What does what:

==================  ====================================================================================================
`acquisition`       one thread that owns camera and projector, and never computes
`preview_watcher`   one thread that looks at the latest preview frame: board, brightness, stillness
`jobs`              one worker that computes, one job after the other; each can be cancelled within a second
`session_reader`    what the session's files say: poses, calibration, verifications, scans, merge
`steps`             the nine steps, and what each is waiting for
`snapshot`          what a panel draws
`autopilot`         plays the whole wizard on the simulated rig, by the same requests
==================  ====================================================================================================

Nothing is remembered beside the session's files: a session that is opened again goes on where it was.
"""
