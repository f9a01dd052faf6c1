"""The wizard's engine, without a face: requests go in, a frozen snapshot comes out, and threads do the rest.

`operator.Operator` is the door. Who does what:

===============  ====================================================================================================
`acquisition`    one thread that owns camera and projector, and never computes
`watching`       one thread that looks at the latest preview frame: board, brightness, stillness
`jobs`           one worker that computes, one job after the other; each can be cancelled within a second
`reading`        what the session's files say: poses, calibration, verifications, scans, merge
`steps`          the eight steps, and what each is waiting for
`snapshot`       what a panel draws
`autopilot`      plays the whole wizard on the simulated rig, by the same requests
===============  ====================================================================================================

Nothing is remembered beside the session's files: a session that is opened again goes on where it was.
"""
