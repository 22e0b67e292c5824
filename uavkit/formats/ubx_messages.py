"""The u-blox messages that are decoded, as rows of bytes, and the names of those that are counted.

Fields as in u-blox's interface descriptions (u-blox 5 to M8 "Receiver Description Including Protocol Specification",
ZED-F9P "Interface Description"), with their names there; little endian.
"""

import numpy as np

NAV_PVT = np.dtype(
    [
        ("iTOW", "<u4"), ("year", "<u2"), ("month", "u1"), ("day", "u1"), ("hour", "u1"), ("min", "u1"), ("sec", "u1"),
        ("valid", "u1"), ("tAcc", "<u4"), ("nano", "<i4"), ("fixType", "u1"), ("flags", "u1"), ("flags2", "u1"),
        ("numSV", "u1"), ("lon", "<i4"), ("lat", "<i4"), ("height", "<i4"), ("hMSL", "<i4"), ("hAcc", "<u4"),
        ("vAcc", "<u4"), ("velN", "<i4"), ("velE", "<i4"), ("velD", "<i4"), ("gSpeed", "<i4"), ("headMot", "<i4"),
        ("sAcc", "<u4"), ("headAcc", "<u4"), ("pDOP", "<u2"), ("flags3", "<u2"), ("reserved", "V4"),
    ]
)  # fmt: skip
"""84 bytes (u-blox 7); newer receivers append 8. Degrees * 1e-7, mm, mm/s; ``valid``: 1 date, 2 time, 4 fully resolved;
``flags``: 1 gnssFixOK, 2 diffSoln, 6 bits on carrSoln; ``flags3``: 1 invalidLlh (longer form only)."""

NAV_POSLLH = np.dtype(
    [("iTOW", "<u4"), ("lon", "<i4"), ("lat", "<i4"), ("height", "<i4"), ("hMSL", "<i4"), ("hAcc", "<u4"),
     ("vAcc", "<u4")]
)  # fmt: skip
"""Degrees * 1e-7, mm."""

NAV_HPPOSLLH = np.dtype(
    [
        ("version", "u1"), ("reserved", "V2"), ("flags", "u1"), ("iTOW", "<u4"), ("lon", "<i4"), ("lat", "<i4"),
        ("height", "<i4"), ("hMSL", "<i4"), ("lonHp", "i1"), ("latHp", "i1"), ("heightHp", "i1"), ("hMSLHp", "i1"),
        ("hAcc", "<u4"), ("vAcc", "<u4"),
    ]
)  # fmt: skip
"""As POSLLH, with the rest in 1e-9 degrees and 0.1 mm; accuracies in 0.1 mm; ``flags``: 1 invalidLlh."""

NAV_SOL = np.dtype(
    [
        ("iTOW", "<u4"), ("fTOW", "<i4"), ("week", "<i2"), ("gpsFix", "u1"), ("flags", "u1"), ("ecefX", "<i4"),
        ("ecefY", "<i4"), ("ecefZ", "<i4"), ("pAcc", "<u4"), ("ecefVX", "<i4"), ("ecefVY", "<i4"), ("ecefVZ", "<i4"),
        ("sAcc", "<u4"), ("pDOP", "<u2"), ("reserved1", "u1"), ("numSV", "u1"), ("reserved2", "<u4"),
    ]
)  # fmt: skip
"""fTOW in ns; ``flags``: 1 gpsfixOK, 2 diffSoln, 4 wknSet, 8 towSet."""

NAV_VELNED = np.dtype(
    [
        ("iTOW", "<u4"), ("velN", "<i4"), ("velE", "<i4"), ("velD", "<i4"), ("speed", "<u4"), ("gSpeed", "<u4"),
        ("heading", "<i4"), ("sAcc", "<u4"), ("cAcc", "<u4"),
    ]
)  # fmt: skip
"""cm/s."""

NAV_STATUS = np.dtype(
    [("iTOW", "<u4"), ("gpsFix", "u1"), ("flags", "u1"), ("fixStat", "u1"), ("flags2", "u1"), ("ttff", "<u4"),
     ("msss", "<u4")]
)  # fmt: skip
"""``flags``: 1 gpsFixOk, 2 diffSoln, 4 wknSet, 8 towSet; ``flags2``: 6 bits on carrSoln (u-blox 9; before, zero)."""

NAV_TIMEUTC = np.dtype(
    [
        ("iTOW", "<u4"), ("tAcc", "<u4"), ("nano", "<i4"), ("year", "<u2"), ("month", "u1"), ("day", "u1"),
        ("hour", "u1"), ("min", "u1"), ("sec", "u1"), ("valid", "u1"),
    ]
)  # fmt: skip
"""``valid``: 1 time of week, 2 week, 4 UTC (the leap seconds are known)."""

NAV_TIMEGPS = np.dtype(
    [("iTOW", "<u4"), ("fTOW", "<i4"), ("week", "<i2"), ("leapS", "i1"), ("valid", "u1"), ("tAcc", "<u4")]
)
"""``valid``: 1 time of week, 2 week, 4 leap seconds."""

NAV_TIMELS = np.dtype(
    [
        ("iTOW", "<u4"), ("version", "u1"), ("reserved0", "V3"), ("srcOfCurrLs", "u1"), ("currLs", "i1"),
        ("srcOfLsChange", "u1"), ("lsChange", "i1"), ("timeToLsEvent", "<i4"), ("dateOfLsGpsWn", "<u2"),
        ("dateOfLsGpsDn", "<u2"), ("reserved1", "V3"), ("valid", "u1"),
    ]
)  # fmt: skip
"""``srcOfCurrLs``: 0 of the firmware, 255 unknown; ``valid``: 1 currLs."""

TIM_TM2 = np.dtype(
    [
        ("ch", "u1"), ("flags", "u1"), ("count", "<u2"), ("wnR", "<u2"), ("wnF", "<u2"), ("towMsR", "<u4"),
        ("towSubMsR", "<u4"), ("towMsF", "<u4"), ("towSubMsF", "<u4"), ("accEst", "<u4"),
    ]
)  # fmt: skip
"""ms and ns; ``flags``: 4 new falling edge, 3 bits on time base (0 receiver, 1 GNSS, 2 UTC), 32 UTC available, 64 time
valid, 128 new rising edge; ``count`` of rising edges."""

DECODED = {
    0x0102: NAV_POSLLH,
    0x0103: NAV_STATUS,
    0x0106: NAV_SOL,
    0x0107: NAV_PVT,
    0x0112: NAV_VELNED,
    0x0114: NAV_HPPOSLLH,
    0x0120: NAV_TIMEGPS,
    0x0121: NAV_TIMEUTC,
    0x0126: NAV_TIMELS,
    0x0D03: TIM_TM2,
}
"""By class * 256 + number."""
MON_VER = 0x0A04
RAW_MEASUREMENTS = (0x0210, 0x0211, 0x0213, 0x0214, 0x0215)
"""RXM-RAW, SFRB, SFRBX, MEASX, RAWX: what a RINEX converter needs."""

_CLASSES = {
    0x01: "NAV", 0x02: "RXM", 0x04: "INF", 0x05: "ACK", 0x06: "CFG", 0x09: "UPD", 0x0A: "MON", 0x0B: "AID",
    0x0C: "TUN", 0x0D: "TIM", 0x10: "ESF", 0x13: "MGA", 0x21: "LOG", 0x27: "SEC", 0x28: "HNR", 0x29: "NAV2",
    0xF0: "NMEA", 0xF1: "PUBX", 0xF5: "RTCM",
}  # fmt: skip
_NUMBERS = {
    "NAV": (
        "01 POSECEF 02 POSLLH 03 STATUS 04 DOP 05 ATT 06 SOL 07 PVT 09 ODO 10 RESETODO 11 VELECEF 12 VELNED "
        "13 HPPOSECEF 14 HPPOSLLH 20 TIMEGPS 21 TIMEUTC 22 CLOCK 23 TIMEGLO 24 TIMEBDS 25 TIMEGAL 26 TIMELS "
        "27 TIMEQZSS 28 NMI 30 SVINFO 31 DGPS 32 SBAS 34 ORB 35 SAT 36 COV 39 GEOFENCE 3B SVIN 3C RELPOSNED 3D EELL "
        "42 SLAS 43 SIG 60 AOPSTATUS 61 EOE 62 PL"
    ),
    "RXM": (
        "10 RAW 11 SFRB 13 SFRBX 14 MEASX 15 RAWX 20 SVSI 30 ALM 31 EPH 32 RTCM 33 SPARTN 34 COR 41 PMREQ 59 RLM "
        "61 IMES 72 PMP 73 QZSSL6"
    ),
    "INF": "00 ERROR 01 WARNING 02 NOTICE 03 TEST 04 DEBUG",
    "ACK": "00 NAK 01 ACK",
    "CFG": (
        "00 PRT 01 MSG 02 INF 04 RST 06 DAT 08 RATE 09 CFG 11 RXM 13 ANT 16 SBAS 17 NMEA 23 NAVX5 24 NAV5 31 TP5 "
        "34 RINV 39 ITFM 3B PM2 3E GNSS 70 DGNSS 71 TMODE3 8A VALSET 8B VALGET 8C VALDEL"
    ),
    "MON": (
        "02 IO 04 VER 06 MSGPP 07 RXBUF 08 TXBUF 09 HW 0B HW2 21 RXR 27 PATCH 28 GNSS 2E SMGR 31 SPAN 36 COMMS "
        "37 HW3 38 RF 39 SYS"
    ),
    "TIM": "01 TP 03 TM2 04 SVIN 06 VRFY 11 DOSC 12 TOS 13 SMEAS 15 VCOCAL 16 FCHG",
    "ESF": "02 MEAS 03 RAW 10 STATUS 14 ALG 15 INS",
    "MGA": "00 GPS 02 GAL 03 BDS 05 QZSS 06 GLO 20 ANO 21 FLASH 40 INI 60 ACK 80 DBD",
    "LOG": "03 ERASE 04 STRING 07 CREATE 08 INFO 09 RETRIEVE 0B RETRIEVEPOS 0D RETRIEVESTRING 0E FINDTIME",
    "SEC": "01 SIGN 03 UNIQID 09 SIG",
    "HNR": "00 PVT 01 ATT 02 INS",
}


def _names() -> dict[int, str]:
    classes = {name: number for number, name in _CLASSES.items()}
    return {
        classes[kind] * 256 + int(number, 16): f"{kind}-{name}"
        for kind, text in _NUMBERS.items()
        for number, name in zip(text.split()[::2], text.split()[1::2], strict=True)
    }


NAMES = _names()


def name_of_frame(code: int) -> str:
    """Return a message's name, as NAV-PVT; its number where the name is not known, as NAV-0x5F or UBX-0x4101."""
    if code in NAMES:
        return NAMES[code]
    kind = _CLASSES.get(code >> 8)
    return f"{kind}-0x{code & 255:02X}" if kind else f"UBX-0x{code:04X}"
