"""Depth cameras as sources of a pipeline, over the SDKs of their makers.

The nodes `realsense_source`, `orbbec_source`, `oakd_source` and `azure_kinect_source` run `python3 -m conicflow.cameras ADAPTER`.
An adapter is a file of this folder with the function `connect`, which opens a camera or a recording; `SDKS` in `__main__`
lists the packages that it needs. Their common loop, which waits for a camera and reopens it, is in `stream`.
"""
