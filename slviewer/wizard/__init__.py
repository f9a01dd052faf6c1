"""The wizard's state machine without a browser: requests go in, a frozen snapshot comes out,
threads do the work.

`operator.Operator` takes every request. Its parts:

====================  ==============================================================================
`*_requests`          the requests, grouped by topic: methods of the state, which turn what they
                      raise into notices
`engine`              the state behind them, what a new snapshot requires, and what was done last
                      and can be undone
`service`             what the threads of the following have in common, and their timing
`acquisition`         one thread that owns camera and projector, and never computes
`preview_watcher`     analyses the latest preview frame: board, brightness, stillness
`jobs`                one worker that computes, one job after the other; each can be cancelled
                      within a second; and the notices for the operator
`session_reader`      reads poses, calibration and records from the session's files
`pose_plan`           computes where the board should be held next
`steps`               the nine steps, and what each is waiting for
`snapshot`            what a panel draws; `publisher` builds and publishes it
`autopilot`           runs the whole wizard on the simulated rig, by the same requests
====================  ==============================================================================

Nothing is stored outside of the session's files: a session that is opened again continues where it
was.
"""
