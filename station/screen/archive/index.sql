-- What is kept of each recording of a folder. What people may ask for is derived from the entry. Figures of which one is
-- not finite are no JSON to SQLite, and not in the view.
PRAGMA journal_mode = MEMORY;   -- no file beside it that another station might take for its own
PRAGMA synchronous = OFF;       -- what a power cut leaves of it is seen by the checksums, and made anew
PRAGMA cell_size_check = ON;
CREATE TABLE IF NOT EXISTS recordings (
    path TEXT PRIMARY KEY,
    mtime_ns INTEGER,
    size INTEGER,
    entry TEXT,
    figures TEXT,               -- of each gyro of the calibration its name, its source, the states, their sigmas
    checksum INTEGER,
    when_utc_s REAL AS (json_extract(entry, '$.when_utc_s')),
    serial TEXT AS (json_extract(entry, '$.texts.device_serial')),
    devices TEXT AS (json_extract(entry, '$.devices')),
    bench TEXT AS (json_extract(entry, '$.texts.station')),
    script TEXT AS (json_extract(entry, '$.texts.script')),
    outcome TEXT AS (json_extract(entry, '$.texts.outcome'))
);
CREATE VIEW IF NOT EXISTS gyros AS SELECT
    recordings.path, when_utc_s, serial, bench, script, outcome,
    json_extract(value, '$[0]') AS gyro,
    json_extract(value, '$[1]') AS source,
    json_extract(value, '$[2][0]') AS k,
    json_extract(value, '$[2][1]') AS b_rps,
    json_extract(value, '$[2][2]') AS sigma_j_rad,
    json_extract(value, '$[2][3]') AS sigma_k_rad,
    json_extract(value, '$[3][0]') AS sd_k,
    json_extract(value, '$[3][1]') AS sd_b_rps,
    json_extract(value, '$[3][2]') AS sd_sigma_j_rad,
    json_extract(value, '$[3][3]') AS sd_sigma_k_rad
FROM recordings, json_each(figures) WHERE json_valid(figures);
