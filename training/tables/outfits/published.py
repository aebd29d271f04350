"""The figures of LayersNet's tables 4 and 5 (Shao, Loy and Dai 2023, supplement), and what sets them apart from ours.

Errors are Euclidean distances in mm at ten times life size, with a standard deviation; here they are divided by ten.
"""

from __future__ import annotations

CELLS = {  # column of table 4 -> what is in it
    "T": "tight inner garments, no wind",
    "T+W": "tight inner garments, wind",
    "L": "loose inner garments, no wind",
    "L+W": "loose inner garments, wind",
}
CATEGORIES = {  # category of this project's patterns -> the paper's name
    "jacket": "jacket", "hooded_jacket": "jacket + hood", "dress": "dress", "jumpsuit": "jumpsuit", "skirt": "skirt",
    "trousers": "pants", "tshirt": "T-shirt", "top": "top",
}  # fmt: skip
TABLE4 = {  # error at ten times life size [mm] and its spread, in the order of CELLS
    "DeePSD, inner garment alone": ((225.3, 106.4), (239.5, 103.9), (501.3, 300.1), (577.5, 373.9)),
    "MGNet, inner garment alone": ((5219.2, 1565.8), (5186.8, 1754.8), (4432.7, 1438.0), (4595.0, 1215.2)),
    "GarSim, inner garment alone": ((284.2, 145.0), (280.5, 124.5), (534.6, 333.0), (621.1, 403.9)),
    "LayersNet, inner garment alone": ((220.0, 195.3), (258.0, 312.8), (344.7, 244.5), (347.4, 288.9)),
    "DeePSD": ((1072.6, 694.7), (1121.0, 731.7), (887.8, 460.5), (1083.1, 492.2)),
    "GarSim": ((920.2, 608.9), (999.5, 686.2), (929.6, 509.7), (1050.0, 523.4)),
    "LayersNet": ((489.9, 447.7), (508.5, 562.7), (378.0, 293.0), (467.8, 403.7)),
}
TABLE5_COLUMNS = (
    "jacket", "jacket + hood", "dress", "jumpsuit", "skirt", "pants", "T-shirt", "overall", "L-Collision",
    "H-Collision",
)  # fmt: skip
TABLE5 = {  # errors as above, then collisions [%]
    "DeePSD": (
        (1385.3, 886.6), (1087.8, 564.5), (736.8, 466.6), (535.2, 224.7), (1107.3, 769.2), (498.8, 109.5),
        (613.1, 338.2), (1049.8, 549.7), (10.11, 5.31), (23.89, 7.89),
    ),
    "DeePSD+": (
        (1830.1, 803.3), (1566.0, 527.1), (1333.0, 349.2), (1219.0, 186.8), (1194.7, 311.2), (1185.7, 213.3),
        (1202.9, 233.6), (1563.4, 486.8), (8.78, 5.12), (19.47, 6.38),
    ),
    "GarSim+": (
        (1412.1, 886.8), (1139.1, 653.5), (674.4, 451.8), (317.8, 157.4), (689.9, 386.7), (317.8, 150.1),
        (447.6, 303.8), (1028.3, 581.0), (6.03, 4.23), (15.11, 7.11),
    ),
    "LayersNet": (
        (571.9, 451.9), (493.9, 354.2), (397.2, 342.2), (264.0, 200.2), (301.3, 79.3), (234.4, 206.3),
        (273.3, 169.0), (472.8, 343.5), (3.13, 2.22), (10.68, 4.53),
    ),
    "LayersNet+": (
        (567.3, 425.5), (491.4, 361.3), (379.1, 299.7), (260.1, 222.2), (299.5, 92.3), (200.9, 140.1),
        (267.8, 189.6), (467.2, 330.7), (3.77, 2.60), (2.16, 1.46),
    ),
}  # fmt: skip
NOT_COMPARABLE = (
    "Not comparable: D-LAYERS and this set have other garments (22,000 faces against about 1,000), bodies, motions and "
    "materials; the paper's own recordings cross themselves, and it gives no figures of them; its tight and loose "
    "inner garments are jumpsuits and dresses, here the measured distance from the body decides; it does not say how "
    '"overall" weighs categories, here every garment counts once.'
)
