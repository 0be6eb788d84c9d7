# A capture station in PowerShell (5.1, as Windows has it, or 7): every scan that the scanner saves is
# sent, checked, and judged in a line.
#
#     $env:MYOFACE_API_KEY = 'myo_...'
#     powershell -File station.ps1 C:\scans -Url https://faces.example.com
#
# Each folder in C:\scans is a person, each OBJ, PLY, GLB or STL in it a raw scan, named like its file;
# one with neutral, neutre, rest or relaxed as a word of its name is the neutral. Scan again into the same
# file, and the new one takes the old one's place. A file goes in one piece: a line that breaks costs the file anew.
param(
    [Parameter(Mandatory = $true)][string]$Folder,
    [string]$Url = 'http://127.0.0.1:8765',
    [string]$Unit, # of the scans: mm, cm, m, inch, foot, or how many mm it has
    [double]$EyeDistance, # or how far apart the person's pupils are, in mm
    [switch]$Once
)
$ErrorActionPreference = 'Stop'
$Key = @{ Authorization = "Bearer $env:MYOFACE_API_KEY" }
$Done = @{}
$Options = @{}
$Number = 0.0
if ([double]::TryParse($Unit, 'Float', [Globalization.CultureInfo]::InvariantCulture, [ref]$Number)) { $Options.unit = $Number }
elseif ($Unit) { $Options.unit = $Unit }
elseif ($EyeDistance) { $Options.eye_distance_mm = $EyeDistance }
$Formats = '.obj', '.ply', '.glb', '.stl'

function Invoke-Api($Method, $Path, $Body) {
    $request = @{ Method = $Method; Uri = "$Url$Path"; Headers = $Key; UseBasicParsing = $true }
    if ($Body) {
        $request.Body = [Text.Encoding]::UTF8.GetBytes((ConvertTo-Json $Body -Depth 5))
        $request.ContentType = 'application/json'
    }
    Invoke-RestMethod @request
}

function ConvertTo-Base64($Text) { [Convert]::ToBase64String([Text.Encoding]::UTF8.GetBytes($Text)) }

function Send-File($File, $Sha256) {
    $about = @{
        'Upload-Length' = "$($File.Length)"
        'Upload-Metadata' = "filename $(ConvertTo-Base64 $File.Name),sha256 $(ConvertTo-Base64 $Sha256)"
    }
    $upload = Invoke-RestMethod -Method Post -Uri "$Url/v1/uploads" -Headers ($Key + $about) -UseBasicParsing
    $null = Invoke-WebRequest -Method Patch -Uri "$Url/v1/uploads/$($upload.id)" -InFile $File.FullName `
        -Headers ($Key + @{ 'Upload-Offset' = '0' }) -ContentType 'application/offset+octet-stream' -UseBasicParsing
    $upload.id
}

# Letters that are none with an accent, by their numbers: 5.1 does not read this file as UTF-8
$Letters = @{ 0xdf = 'ss'; 0xe6 = 'ae'; 0xc6 = 'AE'; 0x153 = 'oe'; 0x152 = 'OE'; 0xf8 = 'o'; 0xd8 = 'O'; 0x142 = 'l'; 0x141 = 'L' }
$Device = '^(con|prn|aux|nul|(com|lpt)[0-9])(\.|\z)' # no file on Windows can be called so

# A legal name, as the client makes it (myoface/names.py): accents go, what is no letter, digit, _, - or .
# becomes _, and 64 characters stay.
function Get-ScanName($File) {
    $name = $File.BaseName
    if ($name -match $Device) { throw [ApplicationException]::new('this is a device''s name on Windows, and no file''s: rename it') }
    if ($name -cnotmatch '^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}\z' -or $name.EndsWith('.')) {
        $whole = -join ($name.ToCharArray() | ForEach-Object { if ($Letters.ContainsKey([int]$_)) { $Letters[[int]$_] } else { $_ } })
        $plain = $whole.Normalize([Text.NormalizationForm]::FormKD) -replace '[\u0300-\u036f]', ''
        $name = $plain -creplace '[^A-Za-z0-9_.-]+', '_' -creplace '^[^A-Za-z0-9]+|[^A-Za-z0-9]+\z', ''
        $name = $name.Substring(0, [Math]::Min(64, $name.Length)).TrimEnd('.')
    }
    if (-not $name) { throw [ApplicationException]::new('no name can be made of it: a letter of a to z or a digit is needed') }
    if ($name -match $Device) { throw [ApplicationException]::new('this is a device''s name on Windows, and no file''s: rename it') }
    $name
}

# Refuses a file that another one of the person's would take the place of: case tells no two apart (-eq).
function Assert-Alone($File, $Name) {
    foreach ($other in Get-ChildItem -LiteralPath $File.DirectoryName -File | Where-Object { $_.Extension -in $Formats -and $_.Name -cne $File.Name }) {
        try { $its = Get-ScanName $other } catch { continue }
        if ($its -eq $Name) { throw [ApplicationException]::new("it and $($other.Name) would both be called ${Name}: rename one") }
    }
}

function Test-Neutral($File) { ($File.BaseName -creplace '([a-z])([A-Z])', '$1 $2') -match '(?<![A-Za-z])(neutral|neutre|rest|relaxed)(?![A-Za-z])' }

function Get-SubjectId($Person) {
    $note = Join-Path $Person.FullName '.myoface-subject'
    if (-not (Test-Path -LiteralPath $note)) {
        Set-Content -LiteralPath $note (Invoke-Api Post '/v1/subjects' @{ name = $Person.Name }).id
    }
    (Get-Content -LiteralPath $note -TotalCount 1).Trim()
}

function Submit-Scan($File) {
    $name = Get-ScanName $File
    Assert-Alone $File $name
    $sha256 = (Get-FileHash -LiteralPath $File.FullName -Algorithm SHA256).Hash.ToLower()
    $subject = Get-SubjectId $File.Directory
    $captures = "/v1/subjects/$subject/captures"
    $scan = (Invoke-Api Get "${captures}?limit=1000").items | Where-Object { $_.name -eq $name }
    if (-not $scan -or $scan.sha256 -ne $sha256) {
        $new = @{ name = $name; role = 'expression'; upload_id = Send-File $File $sha256 }
        if (Test-Neutral $File) { $new.role = 'neutral' }
        if ($scan) { $new.replaces = $scan.id }
        $scan = Invoke-Api Post $captures $new
    }
    $job = "/v1/jobs/$([guid]::NewGuid())" # our own id: sent twice, it is still one job
    $check = Invoke-Api Put $job @{ kind = 'check_scan'; subject_id = $subject; captures = @($scan.id); options = $Options }
    while ($check.state -notin 'succeeded', 'failed', 'canceled') {
        Start-Sleep -Milliseconds 500
        $check = Invoke-Api Get $job
    }
    if ($check.state -ne 'succeeded') { throw [ApplicationException]::new("the check has $($check.state)") }
    Write-Host "$($File.FullName): $($check.result.summary.verdict)"
    foreach ($finding in $check.result.summary.findings) {
        Write-Host "    $($finding.message): $($finding.advice)"
    }
}

# True of what asking again does not mend: refusals of ours (ApplicationException) and the service's, but for "later".
function Test-Refusal($Fault) {
    if ($Fault.Exception -is [ApplicationException]) { return $true }
    $isForGood = [int]$Fault.Exception.Response.StatusCode -in 404, 409, 410, 413, 422
    $isForGood -and $Fault.ErrorDetails.Message -match '"code":\s*"(?!subject\.busy")'
}

do {
    $scans = Get-ChildItem -LiteralPath $Folder -Recurse -File | Where-Object { $_.Extension -in $Formats }
    foreach ($file in $scans | Sort-Object @({ -not (Test-Neutral $_) }, 'FullName')) {
        $saved = $file.LastWriteTimeUtc
        if ($Done[$file.FullName] -eq $saved -or ([DateTime]::UtcNow - $saved).TotalSeconds -lt 2) { continue }
        try {
            Submit-Scan $file
            $Done[$file.FullName] = $saved
        } catch {
            $isRefused = Test-Refusal $_
            $words = if ($_.ErrorDetails) { $_.ErrorDetails.Message } else { $_ }
            Write-Host "$($file.FullName): $(if ($isRefused) { 'refused' } else { 'waits' }): $words"
            if ($isRefused) { $Done[$file.FullName] = $saved }
        }
    }
    Start-Sleep 1
} until ($Once)
